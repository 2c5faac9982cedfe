"""What the paper printed: its Table II, and the filters and beamwidths that it speaks of."""

from dataclasses import dataclass

import numpy as np

from pipistrelle.config import STRATEGIES
from pipistrelle.estimation.catalogue import PAPERS, entry
from pipistrelle.report.studied import Cell, Study
from pipistrelle.report.variables import BEAM, BEAMWIDTHS, beam_name

FILTERS = {name: entry(name).title for name in PAPERS}
"""The paper's two filters: of these its claims speak, whatever others a study has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Printed:
    """One row of Table II, for one filter: mean and standard deviation of landmarks."""

    filter: str
    beamwidth: float
    """[deg] 0: passive sensing; else fused."""
    full: tuple[float, float]
    total: tuple[float, float]
    """Fully initialised; fully and partially."""


TABLE_II = (
    Printed(filter="ekf", beamwidth=180.0, full=(37.7, 2.9), total=(43.7, 2.6)),
    Printed(filter="ekf", beamwidth=33.2, full=(31.9, 3.3), total=(40.8, 3.2)),
    Printed(filter="ekf", beamwidth=11.4, full=(30.0, 3.3), total=(40.1, 3.2)),
    Printed(filter="ekf", beamwidth=0.0, full=(26.6, 3.3), total=(39.5, 3.4)),
    Printed(filter="fastslam", beamwidth=180.0, full=(39.3, 2.8), total=(43.7, 2.4)),
    Printed(filter="fastslam", beamwidth=33.2, full=(32.6, 3.3), total=(40.7, 3.1)),
    Printed(filter="fastslam", beamwidth=11.4, full=(30.5, 3.2), total=(40.2, 3.1)),
    Printed(filter="fastslam", beamwidth=0.0, full=(22.1, 4.9), total=(39.4, 3.3)),
)
"""Bradley & Abaid, Table II."""
FITTED = {
    ("ekf", "total", 180.0),
    ("fastslam", "total", 180.0),
    ("ekf", "total", 0.0),
    ("fastslam", "total", 0.0),
    ("ekf", "full", 0.0),
}
"""Means of Table II that settings which the paper does not report were fitted to: of the levels,
what is seen at 180 degrees and passively, which both filters see alike; of the rays, what passive
EKF-SLAM places. Active sensing at 180 degrees was held under the paper's passive count besides."""
EXCLUDED = {"ekf": 8, "fastslam": 15}
"""Worlds that the paper dropped, of `WORLDS` (Bradley & Abaid, Sec. V-A)."""
WORLDS = 115
NEAR = 0.25
"""Beamwidths nearer than this are one [deg]: the paper rounds its radii to a tenth of a mm."""
CROSSING = 41.0
"""Below the case that the paper rounds to 42 degrees, where it sees fused overtake active [deg]."""
NARROW = 64.0
"""Below the case that the paper rounds to 65 degrees, where its gap passes one sigma [deg]."""


def papers_cases(study: Study) -> bool:
    """Tell whether a study holds the cases of which the paper speaks.

    Returns: both its filters with all three strategies, at its twelve beamwidths, and no other
    variable; further filters and beamwidths may stand beside them.
    """
    ways = {(name, strategy) for name in FILTERS for strategy in STRATEGIES}
    beams = [variable.name for variable in study.variables] == [BEAM]
    near = [np.any(np.abs(study.beamwidth - width) < NEAR) for width in BEAMWIDTHS]
    return beams and ways <= study.trials.keys() and all(near)


def cell_of(study: Study, printed: Printed) -> Cell | None:
    """Find the cell of a study that a row of Table II speaks of.

    Returns: none where the study has no such case within a quarter of a degree.
    """
    strategy = "fused" if printed.beamwidth else "passive"
    if (printed.filter, strategy) not in study.trials:
        return None
    if strategy == "passive":
        return printed.filter, strategy, 0
    near = np.flatnonzero(np.abs(study.beamwidth - printed.beamwidth) < NEAR)
    return (printed.filter, strategy, int(near[0])) if len(near) else None


def row_name(printed: Printed) -> str:
    """Name a row as Table II does.

    Examples
    --------
    >>> row_name(TABLE_II[1]), row_name(TABLE_II[3])
    ('33°', 'passive (0°)')
    """
    return beam_name(printed.beamwidth) if printed.beamwidth else "passive (0°)"
