"""A little of each campaign, always the same: nothing comes of it that a person must never see."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="children are forked, and found in /proc"),
]

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    ("target", "tries"),
    [
        ("logs", 120),
        ("settings", 100),
        ("studies", 15),
        ("kills", 2),
        ("steps", 400),
        ("ownership", 60),
        ("results", 40),
        ("worlds", 60),
        ("bags", 60),
        ("sounds", 60),
        ("live", 300),
    ],
)
def test_nothing_odd_is_answered_by_a_fault(target, tries):
    command = [sys.executable, "-m", "fuzz", target, "--tries", str(tries), "--seed", "0"]
    done = subprocess.run(command, cwd=TESTS, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
