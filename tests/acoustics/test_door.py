import subprocess
import sys

import pytest

from pipistrelle import acoustics


def test_the_door_is_narrow_and_opens_on_what_it_names():
    from pipistrelle.acoustics.arrivals import Arrivals
    from pipistrelle.acoustics.emitter import beamwidth

    offered = acoustics.__all__
    assert len(offered) <= 8
    assert offered == dir(acoustics)
    assert all(callable(getattr(acoustics, name)) for name in offered)
    assert (acoustics.Arrivals, acoustics.beamwidth) == (Arrivals, beamwidth)


def test_the_door_refuses_what_is_not_behind_it():
    with pytest.raises(AttributeError, match="attribute whisper"):
        acoustics.whisper  # noqa: B018


def test_the_door_is_lazy():
    code = "import sys, pipistrelle.acoustics; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
