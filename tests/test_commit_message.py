"""The rule for commit messages, which a hook keeps."""

import subprocess
import sys
from pathlib import Path

import pytest

RULE = Path(__file__).parents[1] / ".ci" / "commit-message"
HOME = "/".join(("", "home", "ann"))
SOUND = "Matching: wrap bearings before they are compared\n\nAt the back they differed by a turn.\n"


def told(tmp_path: Path, message: str) -> tuple[int, str]:
    """Ask the hook."""
    (tmp_path / "message").write_text(message)
    words = [sys.executable, str(RULE), str(tmp_path / "message")]
    done = subprocess.run(words, capture_output=True, text=True)
    return done.returncode, done.stderr


def test_a_sound_message_is_accepted(tmp_path):
    assert told(tmp_path, SOUND) == (0, "")
    assert told(tmp_path, SOUND + f"# what git adds of {HOME}/project\n") == (0, "")
    assert told(tmp_path, SOUND + "A full device is /dev/full; see docs/study.md.\n") == (0, "")


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("Bags: mend it\n", "nothing says why"),
        ("Bags: mend it\n\n# a remark\n", "nothing says why"),
        ("Bags: " + "x" * 67 + "\n\nwhy\n", "the first line has 73 characters, expected 1 to 72"),
        ("\n", "the first line has 0 characters"),
        ("Bags: mend it.\n\nwhy\n", "without a full stop"),
        ("Bags: mend it\nwhy\n", "the second line holds text"),
        ("Mend the bags\n\nwhy\n", "expected 'Area: verb object'"),
        ("bags: mend it\n\nwhy\n", "expected 'Area: verb object'"),
        ("Merge branch 'other'\n\nwhy\n", "history is a line"),
        (
            f"Bags: mend it\n\nAs {HOME}/try.py shows.\n",
            f"'{HOME}/try.py' is a folder of one machine",
        ),
        ("Bags: mend it\n\nAs {}\\ann shows.\n".format("C:"), "is a folder of one machine"),
        ("Bags: mend it\n\nAs ~/try.py shows.\n", "'~/try.py' is a folder of one machine"),
    ],
)
def test_a_faulty_message_is_refused_with_the_reason(tmp_path, message, fault):
    status, said = told(tmp_path, message)
    assert status == 1
    assert said.startswith("commit message: ")
    assert fault in said
