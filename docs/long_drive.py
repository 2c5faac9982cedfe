"""What a long drive costs the smoother, frame by frame, with and without a window.

    python docs/long_drive.py [FRAMES]

A vehicle drives through streets 200 m long and 40 m apart, one after the other, and back along
their ends to where it began: at 1 m/s with a scan every 0.5 s, which hears range (0.05 m) and
bearing (0.01 rad) of landmarks within 20 m. There is one landmark for ten frames. Without a window
the drive is followed for its first tenth alone.
"""

import sys
import time

import numpy as np

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.geometry import range_and_bearing, wrap

MOTION = Motion(model="unicycle", control_std=(0.05, 0.005))
STEP, STREET, APART, REACH = 0.5, 200.0, 40.0, 20.0
STDS = {"range_std": 0.05, "bearing_std": 0.01}
START = Gaussian(mean=np.zeros(3), covariance=np.diag([0.01, 0.01, 0.001]) ** 2)


def turns(frames: int) -> list[float]:
    """Return the heading that the way has at each frame."""
    headings: list[float] = []
    back = int(0.15 * frames)
    up, street, across = True, int(STREET / STEP), int(APART / STEP)
    while len(headings) < frames - back:
        headings += [0.0 if up else np.pi] * street + [np.pi / 2] * across
        up = not up
    return headings[: frames - back] + [-np.pi / 2] * back


def drawn(frames: int):
    """Draw the path, the controls that led it, the landmarks, and yield scans."""
    rng = np.random.default_rng(1)
    wanted, pose, path, controls = turns(frames), np.zeros(3), [np.zeros(3)], []
    for heading in wanted:
        turn = np.clip(wrap(heading - pose[2]) / STEP, -1.0, 1.0)
        control = np.array([1.0, turn])
        noise = rng.normal(size=2) * MOTION.control_std
        pose = motion_step(MOTION, pose, control + noise, STEP)
        controls.append(control)
        path.append(pose)
    path = np.array(path)
    beside = path[rng.integers(len(path), size=frames // 10), :2]
    landmarks = beside + rng.uniform(-15.0, 15.0, (frames // 10, 2))
    return path, np.array(controls), landmarks, rng


def heard(pose, landmarks, rng, at):
    """Return the scan of what is near."""
    near = np.flatnonzero(np.abs(landmarks - pose[:2]).max(axis=1) < REACH)
    distance, bearing = range_and_bearing(pose, landmarks[near])
    seen = near[distance < REACH]
    far, off = distance[distance < REACH], bearing[distance < REACH]
    return make_scan(
        at, seen, wrap(off + rng.normal(0.0, 0.01, seen.size)),
        range=np.maximum(far + rng.normal(0.0, 0.05, seen.size), 0.01), **STDS,
    )  # fmt: skip


def follow(frames: int, last: int, **changes):
    """Follow a drive, and print what frames cost."""
    path, controls, landmarks, rng = drawn(frames)
    slam = Smoother(motion=MOTION, rays=RayConfig(), **changes)
    belief, took, widest = slam.init(START), [], 0
    for k in range(last):
        scan = heard(path[k + 1], landmarks, rng, STEP * (k + 1))
        began = time.process_time()
        belief, _ = slam.predict(belief, controls[k : k + 1], np.array([STEP]))
        belief = slam.update(belief, scan)
        took.append(1e3 * (time.process_time() - began))
        widest = max(widest, belief.solution.beta.size)
        if (k + 1) % (frames // 20) == 0:
            part = np.array(took[-(frames // 20) :])
            off = np.hypot(*(belief.pose().mean - path[k + 1])[:2])
            print(
                f"{k + 1:6d} frames: median {np.median(part):.2f} ms, "
                f"99 % {np.quantile(part, 0.99):.2f}, "
                f"worst {part.max():.0f}; {len(belief.history.placed)} landmarks, "
                f"{belief.solution.beta.size} columns, {off:.2f} m off",
                flush=True,
            )
    began = time.process_time()
    best = belief.path()
    print(f"the optimum of {last} poses with all covariances: {time.process_time() - began:.1f} s")
    off = np.hypot(*(best.mean - path[: last + 1])[:, :2].T)
    said = np.sqrt(np.mean(best.covariance[:, 0, 0] + best.covariance[:, 1, 1]))
    print(
        f"path off by {np.sqrt(np.mean(off**2)):.3f} m, by its own word {said:.3f} m; "
        f"the widest border {widest} columns"
    )
    return best


if __name__ == "__main__":
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 20000
    print("window of 30 s")
    follow(frames, frames, window=30.0)
    print("no window, the first tenth")
    whole = follow(frames, frames // 10)
    print("window of 30 s, the first tenth")
    part = follow(frames, frames // 10, window=30.0)
    print(f"apart by {np.abs(whole.mean - part.mean).max():.1e}")
