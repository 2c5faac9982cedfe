import subprocess
import sys

import pytest

from pipistrelle import acoustics


def test_the_package_exports_at_most_eight_callables():
    from pipistrelle.acoustics.arrivals import Arrivals
    from pipistrelle.acoustics.emitter import beamwidth

    offered = acoustics.__all__
    assert len(offered) <= 8
    assert offered == dir(acoustics)
    assert all(callable(getattr(acoustics, name)) for name in offered)
    assert (acoustics.Arrivals, acoustics.beamwidth) == (Arrivals, beamwidth)


def test_the_package_refuses_unknown_attributes():
    with pytest.raises(AttributeError, match="attribute whisper"):
        acoustics.whisper  # noqa: B018


def test_importing_the_package_does_not_import_numpy():
    code = "import sys, pipistrelle.acoustics; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
