"""Hear a loudspeaker by two real microphones: `.venv/bin/python docs/real_sound.py FOLDER`.

The folder holds the recordings of one place of the loudspeaker, a file for each microphone, with
LEFT-MIC and RIGHT-MIC in their names, from sk413025/GCC-PHAT-LDV-MIC-Experiment on GitHub, folders
`23-chirp(-0.8m)` and `24-chirp(-0.4m)`. Nothing of it lies here: it has no licence. The figure of
what is heard becomes `images/real_sound.png`.

The loudspeaker says a sweep from 100 Hz to 12 kHz every 2 s, the next as one ends. Of each the part
within BAND is the call, as if a vehicle had called LEAD before it came.
"""

import math
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

BAND, SLOPE, PERIOD, LEAD = (7000.0, 10500.0), (12e3 - 100.0) / 2.0, 2.0, 0.7
"""[Hz], [Hz/s], [s], [s]"""
APART, SPEED = 1.4, 343.0
"""Of the microphones [m]; of sound [m/s]."""
LOUD_DB = 40.0
"""Rows above it are the loudspeaker's direct sound, one of each call."""
DURATION = (BAND[1] - BAND[0]) / SLOPE
TOML = f"""format = 1
speed_of_sound = {SPEED}

[call]
call = "sweep"
sweep = "linear"
band = [{BAND[0]}, {BAND[1]}]
duration = {DURATION:.6f}

[log]
motion = "unicycle"
initial_pose = [0.0, 0.0, 0.0]
initial_pose_std = [0.05, 0.05, 0.05]
velocity_std = 0.1
angular_rate_std = 0.1
range_std = 0.2
bearing_std = 0.06
range_bounds = [0.5, 400.0]
"""


def write_recording(folder, tape):
    """Write the recording of two microphones that stand still, ahead of them the loudspeaker."""
    import soundfile

    sides = [next(folder.glob(f"*{side}-MIC*.wav")) for side in ("LEFT", "RIGHT")]
    (left, rate), (right, _) = map(soundfile.read, sides)
    soundfile.write(tape / "recording.wav", np.column_stack([left, right]), rate, subtype="FLOAT")
    calls = "\n".join(map(str, calls_of(left, rate)))
    (tape / "calls.csv").write_text(f"sample\n{calls}\n")
    side = APART / 2.0  # the microphones look at the loudspeaker: left of the room is on the right
    (tape / "array.csv").write_text(f"channel,x,y\n1,0,{-side}\n2,0,{side}\n")
    (tape / "recording.toml").write_text(TOML)
    seconds = range(math.ceil(left.size / rate) + 2)
    still = "\n".join(f"{second},0,0" for second in seconds)
    (tape / "odometry.csv").write_text(f"time,velocity,angular_rate\n{still}\n")


def calls_of(sound, rate):
    """Return the samples of calls LEAD before each part of a sweep is heard."""
    from scipy.signal import fftconvolve

    t = np.arange(round(DURATION * rate)) / rate
    sent = np.sin(2.0 * np.pi * (BAND[0] + 0.5 * SLOPE * t) * t)
    heard = np.abs(fftconvolve(sound, sent[::-1], mode="valid"))
    loudest, lead, period = heard.argmax(), round(LEAD * rate), round(PERIOD * rate)
    starts = np.arange(loudest % period, heard.size, period)
    there = [heard[max(at - 99, 0) : at + 99].max() > 0.3 * heard[loudest] for at in starts]
    calls = starts[there] - lead
    return calls[(calls > 0) & (calls + period <= sound.size)]


def told(rows):
    """Return bearings, as they are ahead [deg], the difference of ways, and how delays drift."""
    rows = rows.filter(rows["level_db"] > LOUD_DB)
    sine = np.sin(rows["bearing"].to_numpy())
    bearing, way = np.degrees(np.arcsin(sine)), 2.0 * rows["range"].to_numpy()
    call = np.arange(way.size)
    drift, start = np.polyfit(call, way, 1)
    off = way - drift * call - start
    return {
        "calls": way.size,
        "bearing [deg]": bearing.mean(),
        "from call to call [deg]": bearing.std(ddof=1),
        "difference of delays [ms]": 1e3 * APART * sine.mean() / SPEED,
        "deviation of delays, without their drift [us]": 1e6 * off.std(ddof=2) / SPEED,
        "drift [ppm]": 1e6 * drift / SPEED / PERIOD,
    }


def main(folder):
    """Print what was heard of one place of the loudspeaker."""
    from pipistrelle import hear

    with TemporaryDirectory() as name:
        tape = Path(name) / "tape"
        tape.mkdir()
        write_recording(folder, tape)
        done = hear(tape, output=Path(name) / "heard")
        for what, number in told(done.measurements).items():
            print(f"{what}: {number:.6g}")
        picture = Path(__file__).resolve().parent / "images" / "real_sound.png"
        shutil.copy(Path(name) / "heard" / "hearing.png", picture)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
