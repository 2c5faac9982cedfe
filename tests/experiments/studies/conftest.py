"""A small plan, its folder, and what its worlds hold."""

import pytest

from pipistrelle.experiments.studies.study import open_store
from pipistrelle.experiments.studies.world import failed_records
from reference.studies import plan_of


@pytest.fixture
def plan(tmp_path):
    return plan_of(tmp_path)


@pytest.fixture
def folder(tmp_path, plan):
    folder = tmp_path / "study"
    open_store(folder, plan)
    return folder


@pytest.fixture
def records(plan):
    return failed_records(plan, "for want of a better\n")
