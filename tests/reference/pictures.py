"""Missions without their picture, which is most of a short mission's time."""

from contextlib import contextmanager

import pytest


def leave_out_picture(patch: pytest.MonkeyPatch) -> None:
    """Replace the drawing and the writing of a mission's figure by nothing."""
    patch.setattr("pipistrelle.figures.mission.draw_mission", lambda *_, **__: None)
    patch.setattr("pipistrelle.figures.style.save_figure", lambda *_: None)


@contextmanager
def without_picture():
    """Leave out the picture of missions; yield the patch."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_picture(patch)
        yield patch
