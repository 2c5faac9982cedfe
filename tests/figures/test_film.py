import os

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.figures.film import film_writer

PICTURES = [np.full((4, 6, 3), level, np.uint8) for level in (1, 2, 3)]


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Put a shell script in the place of ffmpeg."""
    if os.name == "nt":
        pytest.skip("the stand-in for ffmpeg is a shell script")

    def install(script: str) -> None:
        program = tmp_path / "ffmpeg"
        program.write_text(f"#!/bin/sh\nfor last; do :; done\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)

    return install


def test_ffmpeg_is_given_every_picture_whole_and_in_order(stand_in, tmp_path):
    stand_in('cat > "$last"; echo "$@" > "$last.args"')
    path = tmp_path / "mission.mp4"
    film_writer(path)(iter(PICTURES), path)
    assert path.read_bytes() == b"".join(picture.tobytes() for picture in PICTURES)
    assert "-s 6x4 -r 12.5" in (tmp_path / "mission.mp4.args").read_text()


def test_a_failure_of_ffmpeg_is_told_in_its_own_words(stand_in, tmp_path):
    stand_in("echo 'Unknown encoder libx264' >&2; exit 3")
    path = tmp_path / "mission.mp4"
    with pytest.raises(InputError, match=r"status 3 \(Unknown encoder libx264\).*mission\.gif"):
        film_writer(path)(iter(PICTURES), path)


def test_an_upper_case_ending_will_do(tmp_path):
    path = tmp_path / "MISSION.GIF"
    film_writer(path)(PICTURES, path)
    assert path.read_bytes()[:6] == b"GIF89a"
