"""What every test runs under: kernels where the package keeps them, repeatable examples."""

from hypothesis import settings

import pipistrelle  # noqa: F401 - before anything imports Numba

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
