"""Solve a drive whose sound another simulator made: `.venv/bin/python docs/sound_drive.py [SEED]`.

A vehicle drives an ellipse among 15 reflectors. Eight microphones in a circle of 12 mm record its
sweep and that of a caller at an unknown place. pyroomacoustics computes the samples of each
microphone: its sources are the caller, and each reflector, which repeats what it receives. While a
call lasts the vehicle stands still. `pipistrelle.hear` reads the recording, `pipistrelle.slam`
solves it without labels. Prints the table of `sound.md`.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import pipistrelle
from pipistrelle.arrays.layout import array_text, scattered
from reference.rooms import ARRAYS, RATE, C

SECONDS, PERIOD, WINDOW = 45.0, 0.3, 0.075
"""Duration of the drive, time between calls, and time that is simulated after each call [s]."""
DURATION, BANDS = 2e-3, {"own": (48e3, 30e3), "mate": (75e3, 55e3)}
"""Length [s] and bands [Hz] of the calls, linear sweeps."""
AXES, TURNS = (3.0, 2.0), 1.5
"""Half axes of the ellipse [m], and how often it is driven."""
CALLER, LOUD, NOISE = np.array([-1.0, 4.5]), 300.0, 1.0
"""Position of the caller [m]; amplitude of the calls at 1 m; noise of each sample, std."""
REFLECTED = 0.1
"""Amplitude of an echo at 1 m from its reflector, relative to the received call."""
STDS = {"velocity_std": 0.02, "angular_rate_std": 0.02}
"""Standard deviations of odometry, each 0.1 s [m/s, rad/s]."""


def call(name, late, size):
    """Return samples of a call that arrives late [s], with faded ends."""
    first, last = BANDS[name]
    t = np.arange(size) / RATE - late
    share = np.clip(t / DURATION, 0.0, 1.0)
    edge = np.sin(0.5 * np.pi * np.clip(np.minimum(share, 1.0 - share) / 0.1, 0.0, 1.0)) ** 2
    cycles = first * t + 0.5 * (last - first) * t * t / DURATION
    return np.where((t >= 0.0) & (t < DURATION), edge * np.sin(2.0 * np.pi * cycles), 0.0)


def driven(rng):
    """Return times, odometry (speed, turn rate) and poses each tenth of a second."""
    steps = round(SECONDS / 0.1)
    angle = 2.0 * np.pi * TURNS * np.arange(steps + 1) / steps
    rate, (a, b) = 2.0 * np.pi * TURNS / SECONDS, AXES
    speed = rate * np.hypot(a * np.sin(angle), b * np.cos(angle))
    turn = rate * a * b / ((a * np.sin(angle)) ** 2 + (b * np.cos(angle)) ** 2)
    told = np.column_stack([speed, turn])[:-1]
    made = told + rng.standard_normal(told.shape) * list(STDS.values())
    poses = np.zeros((steps + 1, 3))
    poses[0] = a, 0.0, np.pi / 2
    for k, (v, w) in enumerate(made):
        half = poses[k, 2] + 0.05 * w
        poses[k + 1] = poses[k] + 0.1 * np.array([v * np.cos(half), v * np.sin(half), w])
    return 0.1 * np.arange(steps + 1), told, poses


def reflectors(rng, poses):
    """Draw 15 places at least 0.8 m from the path, 1 m from each other and from the caller."""
    places = [CALLER]
    while len(places) < 16:
        place = rng.uniform((-6.0, -5.0), (6.0, 5.0))
        away = np.hypot(*(np.array(places) - place).T).min()
        if away > 1.0 and np.hypot(*(poses[:, :2] - place).T).min() > 0.8:
            places.append(place)
    return np.array(places[1:])


def recorded(layout, pose, places):
    """Return what the microphones record after a call from a pose, without noise."""
    import pyroomacoustics as pra

    room, size = pra.AnechoicRoom(2, fs=RATE), round(WINDOW * RATE)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    microphones = pose[:2] + layout.position @ np.array([[c, s], [-s, c]])
    whole = 4.0 * np.pi * LOUD  # a source is divided by 4 pi times its distance
    room.add_source(CALLER, signal=whole * call("mate", 0.0, size))
    for place in places:
        sent = np.zeros(size)
        for name, origin in (("own", pose[:2]), ("mate", CALLER)):
            far = np.hypot(*(place - origin))
            sent += REFLECTED / far * call(name, far / C, size)
        room.add_source(place, signal=whole * sent)
    room.add_microphone_array(microphones.T)
    room.simulate()
    late = pra.constants.get("frac_delay_length") // 2
    return room.mic_array.signals[:, late : late + size].T


def write(folder, seed):
    """Write the recording with its truth; return the number of calls."""
    import soundfile

    rng, microphones = np.random.default_rng(seed), ARRAYS["circle"]
    layout = scattered(microphones)
    times, told, poses = driven(rng)
    places = reflectors(rng, poses)
    at = np.arange(1, int(SECONDS / PERIOD)) * round(PERIOD / 0.1)
    form = {"samplerate": RATE, "channels": len(layout.position), "subtype": "FLOAT"}
    gap = round(PERIOD * RATE)
    with soundfile.SoundFile(folder / "tape.wav", "w", **form) as tape:
        tape.write(NOISE * rng.standard_normal((gap, len(layout.position))))
        for k in at:
            sound = NOISE * rng.standard_normal((gap, len(layout.position)))
            heard = recorded(layout, poses[k], places)
            sound[: len(heard)] += heard
            tape.write(sound)

    def table(name, head, rows):
        lines = [",".join(map(repr, map(float, row))) for row in rows]
        (folder / name).write_text("\n".join([head, *lines, ""]))

    samples = gap * np.arange(1, at.size + 1)
    (folder / "calls.csv").write_text("\n".join(["sample", *map(str, samples), ""]))
    (folder / "array.csv").write_text(array_text(microphones))
    table("odometry.csv", "time,velocity,angular_rate", np.column_stack([times[:-1], told]))
    table("truth.csv", "time,x,y,heading", np.column_stack([times, poses]))
    rows = [f"{n},{x!r},{y!r}" for n, (x, y) in enumerate([*places.tolist(), CALLER.tolist()], 1)]
    (folder / "landmarks.csv").write_text("\n".join(["landmark,x,y", *rows, ""]))
    x, y, heading = poses[0].tolist()
    sweep = 'call = "sweep"\nsweep = "linear"\nband = [{}, {}]\ntaper = 0.2\n'
    (folder / "recording.toml").write_text(
        f"format = 1\nspeed_of_sound = {C}\n\n[call]\n{sweep.format(*BANDS['own'])}"
        f"duration = {DURATION}\ndeaf = 0.0025\n"
        f'\n[[callers]]\nname = "mate"\nlandmark = 16\n{sweep.format(*BANDS["mate"])}'
        f'\n[log]\nmotion = "unicycle"\ninitial_pose = [{x}, {y}, {heading}]\n'
        "initial_pose_std = [0.001, 0.001, 0.001]\nvelocity_std = 0.02\nangular_rate_std = 0.02\n"
        "range_std = 0.01\nbearing_std = 0.02\nrange_bounds = [0.5, 12.0]\n"
    )
    return at.size


def main(seed):
    """Write, hear and solve a drive; print the table of the page."""
    with TemporaryDirectory() as place:
        tape, log = Path(place, "tape"), Path(place, "heard")
        tape.mkdir()
        calls = write(tape, seed)
        rows = len(pipistrelle.hear(tape, output=log).measurements)
        marginal = {"association__method": "marginal", "filter__noise": "measured"}
        done = pipistrelle.slam(log, filters=["iekf", "smoother"], **marginal)
    print(f"{calls} calls, {rows} rows\n")
    columns = ("position_rmse_m", "position_rmse_aligned_m", "map_rmse_m", "map_rmse_aligned_m")
    print("| | path | aligned | map | aligned | landmarks | false or duplicated |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for name, run in zip(("invariant EKF", "smoother"), done.summary.to_dicts(), strict=True):
        errors = " | ".join(f"{1e3 * run[column]:.2f} mm" for column in columns)
        found = f"{16 - run['landmarks_missed']} of 16"
        wrong = run["landmarks_false"] + run["landmarks_twice"]
        print(f"| {name} | {errors} | {found} | {wrong} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
