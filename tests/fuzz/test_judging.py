"""Every fault would be seen, and what is none is left alone."""

import pytest

from fuzz.judging import faults_of, unsound_results
from fuzz.running import Ending

RAISED = """\
Traceback (most recent call last):
  File "/x/pipistrelle/verbs/missions.py", line 3, in slam
    read(log)
  File "/x/pipistrelle/detection/logs/folder.py", line 9, in read_log
    return int("x")
ValueError: found 'x', line 12
"""
HUNG = """\
Timeout (0:00:10)!
Thread 0x00007f (most recent call first):
  File "/x/python/pathlib.py", line 3 in read_text
  File "/x/pipistrelle/detection/logs/text_tables.py", line 9 in read_text
  File "/x/pipistrelle/verbs/missions.py", line 3 in slam
"""
WARNED = "/x/pipistrelle/a.py:7: RuntimeWarning: overflow in 3 values\n  return a * b\n"


def faults(said="", found=0, how="returned", printed=""):
    ending = Ending(how=how, found=found, words=("slam", "log"), printed=printed, said=said)
    return faults_of(ending, ["log/log.toml"])


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"said": RAISED, "how": "raised"}, "ValueError: found '...', line N in detection/logs/"),
        ({"said": HUNG, "how": "hung"}, "hangs in detection/logs/text_tables.py:read_text"),
        ({"found": -11, "how": "died"}, "dies of SIGSEGV"),
        ({"said": WARNED}, "RuntimeWarning in a.py: overflow in N values"),
        ({"found": 3}, "ends with status 3"),
        ({"found": 2}, "refuses without a word"),
        ({"found": 2, "said": "pipistrelle: error: no 7\n"}, "without naming the place: no N"),
        ({"found": 2, "said": "pipistrelle: error: log/log.toml: \x1b[31m\n"}, "no terminal"),
        ({"found": 1}, "has status 1 without a word"),
        ({"said": "pipistrelle: error: log/log.toml: x\n"}, "says error, with status 0"),
        ({"said": "malloc failed\n"}, "says what is not its own: malloc failed"),
    ],
)
def test_a_fault_is_seen_and_named_without_its_numbers(given, fault):
    (found,) = faults(**given)
    assert found.startswith("slam: ")
    assert fault in found


@pytest.mark.parametrize(
    "given",
    [
        {"printed": "out\n"},
        {"found": 2, "said": "pipistrelle: error: log/log.toml: found 1, expected 2\n"},
        {"found": 1, "said": "pipistrelle: warning: fused ekf failed\n", "printed": "out\n"},
    ],
)
def test_allowed_results_of_a_command_are_no_fault(given):
    assert faults(**given) == []


def test_a_folder_that_a_refusal_leaves_behind_is_a_fault(tmp_path):
    assert list(unsound_results(tmp_path / "out", 2)) == []
    assert list(unsound_results(tmp_path, 2)) == ["refused, and leaves an empty folder behind"]
