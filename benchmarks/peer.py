"""The EKF beside its peer, where that is installed."""

from importlib.util import find_spec
from subprocess import CalledProcessError

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.table import Row

COMMAND = "./dev bench --only peer"
MISSING = (
    "gtsam_isam2_ms: left out, for gtsam is not installed; the extra `smoother` names it: "
    "python -m pip install 'gtsam>=4.3', in the environment that ./dev made"
)


def measure(rounds: int) -> tuple[list[Row], list[float]]:
    """Time both on one mission in one process: the rows, and what the yardstick took [s]."""
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
    ]
    return rows, [unit]
