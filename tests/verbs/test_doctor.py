"""`pipistrelle doctor`: what is there, and what to mend."""

import re
import sys
from itertools import product

import numpy as np

from pipistrelle.config import Config
from pipistrelle.estimation.data_association.sequential import METHODS
from pipistrelle.experiments.runs import compiling


def test_the_doctor_names_versions_and_folders_and_what_to_mend(obey, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("PIPISTRELLE_DATA", "nowhere")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "kernels")
    status, printed, said = obey("doctor")
    found = dict(re.findall(r"^(\S+(?: \S+)?) {2,}(.+)$", printed, re.M))
    assert (status, said) == (0, "")
    assert found["python"].startswith(sys.version.split()[0])
    assert found["numpy"] == np.__version__
    assert found["kernel cache"] == "kernels"
    assert found["ffmpeg"].startswith("not found")
    assert found["PIPISTRELLE_DATA"].startswith("nowhere: holds no folder mrclam")
    assert int(found["cores"]) >= 1


def test_the_doctor_names_a_missing_library_with_its_fix(obey, monkeypatch):
    monkeypatch.setattr("pipistrelle.verbs.doctor.requires", lambda _: ["nosuchthing>=2; x"])
    monkeypatch.delenv("PIPISTRELLE_DATA", raising=False)
    printed = obey("doctor")[1]
    assert "nosuchthing       not found; python -m pip install 'nosuchthing>=2'" in printed
    assert "PIPISTRELLE_DATA  not set" in printed


def test_the_doctor_names_the_extra_that_brings_a_library(obey, monkeypatch):
    told = ["numpy>=2; extra == 'one'", 'nosuchthing>=2; (x) and extra == "two-b"']
    monkeypatch.setattr("pipistrelle.verbs.doctor.requires", lambda _: told)
    printed = obey("doctor")[1]
    assert f"numpy             {np.__version__} (extra one)\n" in printed
    missing = "not found (extra two-b); python -m pip install 'nosuchthing>=2'"
    assert f"nosuchthing       {missing}\n" in printed


def test_doctor_compiles_the_kernels_of_all_estimators_if_asked(obey, monkeypatch):
    asked = []
    monkeypatch.setattr(compiling, "run_mission", lambda config, *_: asked.append(config))
    monkeypatch.setattr(compiling, "try_trial", lambda case, *_: asked.append(case))
    assert "kernels" not in obey("doctor")[1].replace("kernel cache", "")
    assert asked == []
    status, printed, said = obey("doctor", "--compile")
    assert (status, said) == (0, "")
    assert "compiled or loaded" in printed.splitlines()[-1]
    configs = [config for config in asked if isinstance(config, Config)]
    methods = {(c.association.method, c.listening.excess_paths) for c in configs}
    assert methods == {*product(("known", *METHODS), (False, True))}
