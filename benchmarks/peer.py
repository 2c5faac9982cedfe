"""Comparison of the EKF and the smoother with GTSAM, if installed."""

from collections.abc import Iterator
from importlib.util import find_spec
from subprocess import CalledProcessError

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.table import Row

COMMAND = "./dev bench --only peer"
MISSING = (
    "gtsam_isam2_ms: left out, for gtsam is not installed: "
    "python -m pip install 'gtsam>=4.3', in the environment that ./dev made"
)


def measure(rounds: int) -> tuple[list[Row], list[float]]:
    """Time the solvers on a mission in a separate process; return rows and calibration time [s]."""
    if find_spec("gtsam") is None:
        print(MISSING)
        return [], []
    try:
        told = answer("-m", "benchmarks.isam2", str(rounds))
    except CalledProcessError:
        print("gtsam_isam2_ms: left out, for gtsam fails here as said above")
        return [], []
    isam2, ekf, unit = told["isam2_s"], told["ekf_s"], told["calibration_s"]
    rows = [
        row(
            "gtsam_isam2_ms",
            1e3 * isam2,
            COMMAND,
            ratio=isam2 / unit,
            note=f"in GTSAM's own calls ({1e3 * told['isam2_with_python_s']:.0f} ms with the "
            f"Python around them); position RMSE over the frames {told['isam2_m']:.2f} m as "
            f"driven, {told['isam2_smoothed_m']:.2f} m smoothed; the EKF's {told['ekf_m']:.2f} m; "
            f"at the end {told['isam2_last_m']:.2f} m and {told['ekf_last_m']:.2f} m; "
            f"{told['mapped']} landmarks in the graph, {told['waiting']} never placed",
        ),
        row(
            "isam2_over_ekf",
            isam2 / ekf,
            COMMAND,
            ratio=isam2 / ekf,
            note=f"of the same mission in the same process; there the EKF took {1e3 * ekf:.1f} ms",
        ),
        *_over_the_smoother(told),
    ]
    return rows, [unit]


def _over_the_smoother(told: dict[str, float]) -> Iterator[Row]:
    """Yield the rows of GTSAM's times over the smoother's, and of the smoother's batch."""
    online, batch, peers = told["smoother_s"], told["batch_s"], told["isam2_batch_s"]
    for name, ratio, note in (
        (
            "isam2_over_smoother",
            told["isam2_s"] / online,
            f"the smoother online, with all covariances: {1e3 * online:.1f} ms",
        ),
        (
            "isam2_over_batch",
            told["isam2_s"] / batch,
            f"the smoother at once, from the EKF's track: {1e3 * batch:.1f} ms",
        ),
        (
            "gtsam_batch_over_batch",
            peers / batch,
            f"GTSAM's optimiser at once, from the same track: {1e3 * peers:.1f} ms",
        ),
        ("batch_over_ekf", batch / told["ekf_s"], ""),
    ):
        yield row(name, ratio, COMMAND, ratio=ratio, note=note)
