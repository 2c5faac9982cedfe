"""The version: what the tags of a clone say, what a build says, and that nobody pays to load it."""

import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from hatchling.metadata.core import ProjectMetadata
from hatchling.plugin.manager import PluginManager

import pipistrelle
from pipistrelle.version import UNKNOWN, find_version, version_of_clone

ROOT = Path(__file__).resolve().parents[1]
SOMEBODY = ("-c", "user.name=Somebody", "-c", "user.email=somebody@example.org")


def git(folder: Path, *words: str) -> str:
    """Run git in a folder, whatever the user's own settings."""
    alone = os.environ | {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
    command = ["git", *SOMEBODY, *words]
    return subprocess.run(
        command, cwd=folder, env=alone, check=True, capture_output=True, text=True
    ).stdout.strip()


def built(folder: Path) -> str:
    """Return the version that a build of a folder would have."""
    with warnings.catch_warnings(action="ignore"):
        return ProjectMetadata(str(folder), PluginManager()).version


def sources(folder: Path) -> Path:
    """Copy into a folder what a version is made of."""
    folder.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", ".git_archival.txt", ".gitattributes"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture
def clone(tmp_path):
    """A clone of one commit."""
    folder = sources(tmp_path / "clone")
    git(folder, "init", "-q", "-b", "main")
    git(folder, "add", ".")
    git(folder, "commit", "-q", "-m", "One")
    return folder


def test_the_tag_of_a_release_is_its_version(clone):
    git(clone, "tag", "v0.1.0")
    assert version_of_clone(clone) == built(clone) == "0.1.0"


def test_a_commits_version_has_distance_and_hash(clone):
    one = git(clone, "rev-parse", "--short=9", "HEAD")
    assert version_of_clone(clone) == built(clone) == f"0.1.dev1+g{one}"
    git(clone, "tag", "v0.1.0")
    git(clone, "commit", "-q", "--allow-empty", "-m", "Two")
    two = git(clone, "rev-parse", "--short=9", "HEAD")
    assert version_of_clone(clone) == built(clone) == f"0.1.1.dev1+g{two}"
    with (clone / "README.md").open("a") as text:
        text.write("changed")
    assert re.fullmatch(rf"0\.1\.1\.dev1\+g{two}\.d\d{{8}}", version_of_clone(clone))
    assert version_of_clone(clone) == built(clone)


def test_a_shallow_clone_knows_its_commit_and_complains_of_nothing(clone, tmp_path):
    git(clone, "commit", "-q", "--allow-empty", "-m", "Two")
    git(tmp_path, "clone", "-q", "--depth", "1", clone.as_uri(), "shallow")
    here = git(clone, "rev-parse", "--short=9", "HEAD")
    assert version_of_clone(tmp_path / "shallow") == f"0.1.dev1+g{here}"
    assert built(tmp_path / "shallow") == f"0.1.dev1+g{here}"


def test_an_archive_of_a_release_knows_its_version_without_git(clone, tmp_path):
    git(clone, "tag", "v0.1.0")
    git(clone, "archive", "-o", str(tmp_path / "archive.zip"), "HEAD")
    shutil.unpack_archive(tmp_path / "archive.zip", tmp_path / "archive")
    assert version_of_clone(tmp_path / "archive") is None, "it is no clone"
    assert built(tmp_path / "archive") == "0.1.0"


def test_a_bare_copy_can_be_built_and_its_version_is_unknown(tmp_path):
    assert version_of_clone(sources(tmp_path / "copy")) is None
    assert built(tmp_path / "copy") == UNKNOWN


def test_another_project_that_holds_a_copy_lends_it_no_version(clone):
    git(clone, "tag", "v7.0")
    text = (clone / "pyproject.toml").read_text()
    (clone / "pyproject.toml").write_text(text.replace('"pipistrelle"', '"theirs"'))
    assert version_of_clone(clone) is None


@pytest.mark.parametrize("text", ["", "[project", "[project]\nversion = '7'"])
def test_a_broken_project_file_is_no_clone(clone, text):
    (clone / "pyproject.toml").write_text(text)
    assert version_of_clone(clone) is None


def test_without_hatch_vcs_a_clone_has_the_version_that_was_installed(clone, monkeypatch):
    monkeypatch.setitem(sys.modules, "setuptools_scm", None)
    assert version_of_clone(clone) is None
    assert version_of_clone(ROOT) is None


def test_without_git_a_clone_has_the_version_that_was_installed(clone, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert version_of_clone(clone) is None
    assert built(clone) == UNKNOWN


def test_all_places_state_the_same_version(tmp_path):
    from pipistrelle.config import Config
    from pipistrelle.experiments.drives import NO_TRUTH
    from pipistrelle.experiments.results.writing import write_results
    from pipistrelle.files import RESULTS, OwnFiles
    from pipistrelle.report import page

    mission = {"command": "pipistrelle", "seed": 7, "trials": (), "ignored_rows": {}}
    write_results(OwnFiles(tmp_path, RESULTS), config=Config(), truth=NO_TRUTH, **mission)
    kept = json.loads((tmp_path / "summary.json").read_text())["version"]
    command = [sys.executable, "-m", "pipistrelle", "--version"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    assert kept == told == find_version() == pipistrelle.__version__ == page.__version__
    assert f"Pipistrelle {kept}, seed 7" in (tmp_path / "README.md").read_text()


def test_to_import_the_package_loads_nothing_else():
    code = (
        "import sys; before = set(sys.modules); import pipistrelle; "
        "print(*(set(sys.modules) - before))"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.split() == ["pipistrelle"]


def test_the_package_has_no_other_attribute_of_that_kind():
    with pytest.raises(AttributeError, match="no attribute 'verzion'"):
        _ = pipistrelle.verzion
