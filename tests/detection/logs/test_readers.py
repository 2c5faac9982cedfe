"""Which reader a folder gets: by its files, the given ones first, the package's own at last."""

import shutil
from pathlib import Path

import pytest

from pipistrelle.detection.logs.folder import read_log, read_mrclam
from pipistrelle.detection.logs.readers import LOG_FOLDER, MRCLAM, READERS, Reader, reader_of

DATA = Path(__file__).parents[2] / "data"
TAPE = Reader(
    name="tape", title="a tape", recognises=lambda folder: (folder / "tape").exists(), read=print
)


@pytest.fixture
def made_up(tmp_path):
    return Path(shutil.copytree(DATA / "mrclam_made_up", tmp_path / "set"))


def test_a_format_is_recognised_by_its_files(made_up):
    assert reader_of(DATA / "unicycle_log") is LOG_FOLDER
    assert reader_of(made_up) is MRCLAM
    (made_up / "Barcodes.dat").unlink()
    assert reader_of(made_up) is MRCLAM
    (made_up / "log.toml").touch()
    assert reader_of(made_up) is LOG_FOLDER


def test_an_unrecognised_folder_is_read_as_a_log_folder(tmp_path):
    assert reader_of(tmp_path) is LOG_FOLDER
    assert reader_of(tmp_path, [TAPE]) is LOG_FOLDER


def test_a_given_reader_is_asked_first(made_up):
    (made_up / "tape").touch()
    assert reader_of(made_up, [TAPE]) is TAPE
    assert reader_of(made_up) is MRCLAM


def test_robots_of_a_set_are_listed_by_their_odometry_files(made_up):
    assert MRCLAM.robots(made_up) == [1]
    (made_up / "Robot4_Odometry.dat").touch()
    assert MRCLAM.robots(made_up) == [1, 4]


def test_each_reader_equals_its_formats_function():
    assert LOG_FOLDER.read(DATA / "bicycle_log").time.tolist() == (
        read_log(DATA / "bicycle_log").time.tolist()
    )
    span = (1248440001.51, 1248440004.321)
    log = MRCLAM.read(DATA / "mrclam_made_up", 1, span=span)
    assert log.time.tolist() == read_mrclam(DATA / "mrclam_made_up", 1, span).time.tolist()


def test_every_format_has_a_unique_name_and_a_help_text():
    assert len({reader.name for reader in READERS}) == len(READERS)
    assert all(reader.help for reader in READERS)
    assert all(bool(reader.robots) == bool(reader.robot_help) for reader in READERS)
