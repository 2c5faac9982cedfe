"""A release: distributions that hold all that is needed, workflows that try every Python."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PAGES = [path.read_text() for path in (ROOT / "docs").glob("*.md")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = {
    path.stem: yaml.safe_load(path.read_text())
    for path in (ROOT / ".github" / "workflows").glob("*.yml")
}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Both distributions of these sources: the sources' own, and the wheel made of them."""
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "-d"]
    subprocess.run([*build, folder, "-t", "sdist"], cwd=ROOT, check=True, capture_output=True)
    (sources,) = folder.glob("*.tar.gz")
    with tarfile.open(sources) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # not in 3.11.2
        archive.extractall(folder)
    unpacked = folder / sources.name.removesuffix(".tar.gz")
    subprocess.run([*build, folder, "-t", "wheel"], cwd=unpacked, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return unpacked, wheel


def package_files(root: Path) -> set[str]:
    """List a package's files, compiled ones left out."""
    paths = (path for path in root.rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {path.relative_to(root).as_posix() for path in paths}


def test_the_wheel_contains_exactly_the_files_of_the_package(built):
    unpacked, wheel = built
    here = package_files(ROOT / "src" / "pipistrelle")
    assert {"py.typed", "experiments/studies/paper.toml", "report/page.html"} <= here
    names = zipfile.ZipFile(wheel).namelist()
    assert {name for name in names if ".dist-info/" not in name} == {
        f"pipistrelle/{name}" for name in here
    }
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert package_files(unpacked / "src" / "pipistrelle") == here


def test_the_wheel_made_of_the_sources_has_their_version(built):
    unpacked, wheel = built
    assert wheel.name.startswith(f"{unpacked.name}-py3-none-any")
    assert f"Version: {unpacked.name.removeprefix('pipistrelle-')}\n" in (
        unpacked / "PKG-INFO"
    ).read_text(encoding="utf-8")


def test_the_sources_can_be_tested_and_set_up(built):
    unpacked, _ = built
    for name in (
        "dev",
        "requirements.lock",
        "tests/test_release.py",
        "conftest.py",
        "docs/conf.py",
    ):
        assert (unpacked / name).is_file(), name


def test_every_python_that_is_promised_is_tried_by_the_workflows():
    promised = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert PROJECT["requires-python"] == f">={promised[0]}"
    jobs = WORKFLOWS["ci"]["jobs"]["test"], WORKFLOWS["release"]["jobs"]["try"]
    assert [job["strategy"]["matrix"]["python-version"] for job in jobs] == [promised] * 2


def test_only_a_tested_release_is_published_by_one_job():
    jobs = WORKFLOWS["release"]["jobs"]
    assert jobs["publish"]["needs"] == ["test", "try", "lowest"]
    assert jobs["try"]["needs"] == "build"
    may = [
        (name, job)
        for name, flow in WORKFLOWS.items()
        for job, told in flow["jobs"].items()
        if "id-token" in told.get("permissions", flow["permissions"])
    ]
    assert may == [("release", "publish")]


def test_the_build_of_a_release_knows_the_tags():
    (checkout,) = [
        step
        for step in WORKFLOWS["release"]["jobs"]["build"]["steps"]
        if step.get("uses", "").startswith("actions/checkout@")
    ]
    assert checkout["with"]["fetch-depth"] == 0


def test_every_extras_package_is_imported_and_documented():
    sources = [path.read_text() for path in (ROOT / "src" / "pipistrelle").rglob("*.py")]
    for extra, needed in PROJECT["optional-dependencies"].items():
        for requirement in needed:
            name = re.split(r"[^\w]", requirement, maxsplit=1)[0]
            used = re.compile(rf"^ *(?:import|from) {name}\b", re.MULTILINE)
            assert any(used.search(text) for text in sources), f"{extra}: {name}"
            assert any(f"'.[{extra}]'" in page for page in PAGES), extra
