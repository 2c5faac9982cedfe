"""Make `reference`, the slow second versions, importable; let kernels take time to compile."""

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parents[1]))
settings.register_profile("kernels", deadline=None, derandomize=True)
settings.load_profile("kernels")
