"""Small sound recordings: a short drive, recorded by few microphones."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipistrelle.verbs.command_line import obey
from reference.pictures import without_picture

FEW = ("--receiver.elements", "4", "--landmarks", "20", "--duration", "4", "--seed", "7")
"""A drive of eight frames among few landmarks, for sixteen microphones."""
UNLABELLED = ("--association.method", "marginal", "--listening.excess-paths", "true")


def record(folder, *words, drive=FEW):
    """Write a recording with `pipistrelle run`; return its folder."""
    with TemporaryDirectory() as place, redirect_stdout(StringIO()), without_picture():
        line = ["run", *drive, "--strategy", "fused", "--quiet", "-o", f"{place}/run"]
        assert obey([*line, "--save-sound", str(folder), *words]) == 0
    return Path(folder)


def with_samples(folder, change, name="tape.wav", subtype="FLOAT"):
    """Change the samples of a recording in place, or replace them by the returned ones."""
    import soundfile

    samples, rate = soundfile.read(folder / name, dtype="float32")
    changed = change(samples)
    soundfile.write(folder / name, samples if changed is None else changed, rate, subtype=subtype)


ABOUT = """format = 1
speed_of_sound = {speed}
start = 10.0

[call]
frequency = {frequency}
duration = {duration}

[log]
motion = "unicycle"
initial_pose = [0.0, 0.0, 0.0]
initial_pose_std = [0.0, 0.0, 0.0]
velocity_std = 0.1
angular_rate_std = 0.1
range_std = 0.2
bearing_std = 0.1
range_bounds = [0.5, 20.0]
"""


def foreign(
    folder,
    *,
    rate=192_000,
    frequency=41_300.0,
    duration=6.3e-4,
    calls=(1000, 25_000, 47_000),
    place=(1.2, 0.5),
    amplitude=0.02,
    noise=1e-3,
    leak=0.5,
    gain=None,
    faces=True,
    seed=1,
):
    """Write a recording as another program would: point source, positions, delays, by definition.

    Each of sixteen microphones on four sides records the call itself, and the echo of a point [m],
    as real sound at its true distance; behind a face nothing, without faces all directions.
    """
    import soundfile

    folder.mkdir(exist_ok=True)
    rows = []
    for face, turn in enumerate(np.arange(4) * np.pi / 2, start=1):
        for y in (np.arange(4) - 1.5) * 0.004:
            x, y = 0.008 * np.cos(turn) - y * np.sin(turn), 0.008 * np.sin(turn) + y * np.cos(turn)
            rows.append((len(rows) + 1, x, y, face))
    time = np.arange(calls[-1] + 24_000) / rate
    sound = noise * np.random.default_rng(seed).standard_normal((time.size, 16))
    centre = np.hypot(*place)
    for begin in calls:
        here, pulse = _within(time, begin / rate, duration, _pulse, frequency)
        sound[here] += leak * pulse[:, None]
        for number, x, y, face in rows if amplitude else ():
            turn = (face - 1) * np.pi / 2
            if faces and np.cos(turn) * place[0] + np.sin(turn) * place[1] < 0.0:
                continue  # behind the face
            ahead = (x * place[0] + y * place[1]) / centre
            late = begin / rate + (2.0 * centre - ahead) / 340.0
            here, pulse = _within(time, late, duration, _pulse, frequency)
            sound[here, number - 1] += amplitude * pulse
    sound *= np.ones(16) if gain is None else gain
    soundfile.write(folder / "tape.wav", sound.astype(np.float32), rate, subtype="FLOAT")
    lines = [f"{channel},{float(x)!r},{float(y)!r},{face}" for channel, x, y, face in rows]
    if not faces:
        lines = [line.rpartition(",")[0] for line in lines]
    header = "channel,x,y,face" if faces else "channel,x,y"
    array = "\n".join([header, *lines, ""])
    write_beside(folder, frequency, duration, 340.0, array, calls, until=10)
    return folder


def write_beside(folder, frequency, duration, speed, array, calls, *, until):
    """Write the other files of a recording: description, array, calls, a vehicle at rest.

    `until` [s] is the minimum end of the odometry; the sound begins at 10 s.
    """
    about = ABOUT.format(frequency=frequency, duration=duration, speed=speed)
    (folder / "recording.toml").write_text(about)
    (folder / "array.csv").write_text(array)
    (folder / "calls.csv").write_text("\n".join(["sample", *map(str, calls), ""]))
    rest = "".join(f"{second},0,0\n" for second in range(9, until + 3, 3))
    (folder / "odometry.csv").write_text(f"time,velocity,angular_rate\n{rest}")


def _within(time, begin, duration, call, *more):
    """Return the samples about a call that begins at a time [s], and the call in them."""
    first, last = np.searchsorted(time, [begin - 1e-4, begin + duration + 1e-4])
    return slice(first, last), call(time[first:last] - begin, duration, *more)


def _pulse(time, duration, frequency):
    """Return a tone burst at times since its start [s]."""
    inside = (time >= 0.0) & (time < duration)
    return np.where(inside, np.cos(2.0 * np.pi * frequency * time), 0.0)


def swept(folder, late, *, deaf=3e-3, faint=10e-3, period=0.05, rate=96_000, loud=3.0, seed=1):
    """Write another program's recording of a sweep by eight microphones in a circle of 2 cm.

    Each call has an echo from ahead after the delay in `late` [s], 75 dB above the noise of a beam,
    and a faint echo from the left. Returns the folder, and the time of each call.
    """
    import soundfile

    duration, turn = 2e-3, np.arange(8) * np.pi / 4
    place = 0.02 * np.stack((np.cos(turn), np.sin(turn)), axis=1)
    step = round(period * rate)
    begin = 1000 + step * np.arange(len(late))
    time = np.arange(begin[-1] + step) / rate
    sound = 1e-3 * np.random.default_rng(seed).standard_normal((time.size, 8))
    for first, delay in zip(begin, late, strict=True):
        here, call = _within(time, first / rate, duration, _swept)
        sound[here] += 0.5 * call[:, None]
        for level, after, toward in ((loud, delay, place[:, 0]), (0.02, faint, place[:, 1])):
            for m in range(8):
                begun = first / rate + after - toward[m] / 340
                here, call = _within(time, begun, duration, _swept)
                sound[here, m] += level * call
    folder.mkdir(exist_ok=True)
    soundfile.write(folder / "tape.wav", sound.astype(np.float32), rate, subtype="FLOAT")
    rows = [f"{m + 1},{x!r},{y!r}" for m, (x, y) in enumerate(place.tolist())]
    write_beside(
        folder, 29e3, duration, 340.0, "\n".join(["channel,x,y", *rows, ""]), begin, until=20
    )
    about = (folder / "recording.toml").read_text()
    sweep = f'call = "sweep"\nband = [36000.0, 22000.0]\ntaper = 0.2\ndeaf = {deaf}\n'
    (folder / "recording.toml").write_text(about.replace("frequency = 29000.0\n", sweep))
    return folder, 10.0 + begin / rate


def _swept(time, duration):
    """Return a sweep from 36 to 22 kHz with faded ends, at times since its start [s]."""
    inside, share = (time >= 0.0) & (time < duration), np.clip(time / duration, 0.0, 1.0)
    edge = np.sin(0.5 * np.pi * np.clip(np.minimum(share, 1.0 - share) / 0.1, 0.0, 1.0)) ** 2
    return np.where(inside, edge * np.sin(2.0 * np.pi * (36e3 - 7e3 * share) * time), 0.0)
