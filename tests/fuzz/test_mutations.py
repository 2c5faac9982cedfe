"""A mutation depends on its seed alone, and takes whatever another has left."""

import numpy as np
import pytest

from fuzz.logs import LOGS, sound
from fuzz.mutations import BYTES, CELLS, LINES, TOML, spoiled

FILES = [(name, data) for log in LOGS for name, data in sound(log).items()]
ALL = sorted({*BYTES, *LINES, *CELLS, *TOML}, key=lambda mutation: mutation.__name__)


@pytest.mark.parametrize("mutation", ALL, ids=lambda mutation: mutation.__name__)
def test_a_mutation_is_the_same_again_and_changes_most_files(mutation):
    changed = 0
    for seed, (_, data) in enumerate(FILES):
        once, again = (mutation(np.random.default_rng(seed), data) for _ in range(2))
        assert once == again
        changed += once[1] != data
    assert changed >= len([name for name, _ in FILES if name.endswith(".toml")])


def test_a_file_can_be_spoiled_over_and_over():
    for number, (name, sound_data) in enumerate(FILES):
        rng, data = np.random.default_rng(number), sound_data
        for _ in range(20):
            told, data = spoiled(rng, name, data)
            data = data[:100_000]
            assert told.startswith(name)
