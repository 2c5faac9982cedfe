"""The EKF and the smoother beside their peers, where these are installed."""

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
    ours, batch, peers_batch = told["smoother_s"], told["batch_s"], told["isam2_batch_s"]
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
        row(
            "isam2_over_smoother",
            isam2 / ours,
            COMMAND,
            ratio=isam2 / ours,
            note=f"the smoother online, with all covariances: {1e3 * ours:.1f} ms",
        ),
        row(
            "isam2_over_batch",
            isam2 / batch,
            COMMAND,
            ratio=isam2 / batch,
            note=f"the smoother at once, from the EKF's track: {1e3 * batch:.1f} ms",
        ),
        row(
            "gtsam_batch_over_batch",
            peers_batch / batch,
            COMMAND,
            ratio=peers_batch / batch,
            note=f"GTSAM's optimiser at once, from the same track: {1e3 * peers_batch:.1f} ms",
        ),
        row("batch_over_ekf", batch / ekf, COMMAND, ratio=batch / ekf),
    ]
    return rows, [unit]
