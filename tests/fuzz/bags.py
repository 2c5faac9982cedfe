"""Spoiled ROS bags, for `pipistrelle slam`."""

import math
from pathlib import Path

from numpy.random import Generator

from fuzz.judging import Tried, contents, faults_of, lost, unsound_results
from fuzz.logs import Files, lay, replaced
from fuzz.mutations import BYTES, flipped, one_of
from fuzz.running import command, undrawn
from reference.bags import (
    DETECTIONS,
    LABELLED,
    ODOMETRY,
    RANGE,
    header,
    labelled,
    odometry,
    static,
    write_bag,
)

BAGS: dict[str, str | None] = {
    "walk.mcap": None,
    "walk.db3": None,
    "walk.bag": None,
    "packed.mcap": "STORAGE",
    "packed.bag": "LZ4",
    "folder": "MESSAGE",
}
"""Names of sound bags, and how they are compressed."""
MANNERS = ((), (), ("--truth", "/true"), ("--topics",), ("--bag.motion", "twist"))
WAYS = (*BYTES, *([flipped] * len(BYTES)))
"""Flipped bits are what most bags survive."""
ODD = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e12, 1e300, 4.0)
SINGLE = 3e38
"""Nearly the largest number of single precision, in which a `Range` is told."""


def told(odd: float | None = None, at: int = -1) -> list:
    """Tell a short drive past a post; one message of one topic may hold an odd number."""
    messages = [("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, static("base_link", "s", 0.1, 0.0))]
    for i in range(20):
        time, x = round(0.1 * i, 1), 0.05 * i
        far = odd if odd is not None and i == at else math.hypot(2.0 - x, 1.0)
        ping = {"ping_info": {"sound_speed": 340.0}, "two_way_travel_times": [far / 170.0]}
        front = {"field_of_view": 0.3, "min_range": 0.1, "max_range": 9.0}
        front["range"] = far if abs(far) != 1e300 else SINGLE
        place = odd if odd is not None and i == at + 1 else x
        messages += [
            ("/odom", ODOMETRY, time, odometry(time, place, 0.0, 0.0, 0.5)),
            ("/true", ODOMETRY, time, odometry(time, x, 0.0, 0.0)),
            ("/seen", LABELLED, time, labelled(time, [(3, math.atan2(1.0, 2.0 - x), far)])),
            ("/ping", DETECTIONS, time, {"header": header(time, "s"), "rx_angles": [0.4]} | ping),
            ("/front", RANGE, time, {"header": header(time, "s")} | front),
        ]
    return messages


def prepare(base: Path) -> dict[str, Files]:
    """Write the sound bags; return the files of each."""
    made = {}
    for name, how in BAGS.items():
        path = write_bag(base / name, told(), compression=how)
        inside = sorted(path.iterdir()) if path.is_dir() else [path]
        made[name] = {file.name: file.read_bytes() for file in inside}
    return made


def attempt(rng: Generator, place: Path, sound: dict[str, Files]) -> Tried:
    """Spoil a bag, and have it solved."""
    name = one_of(rng, [*sound])
    files, words = dict(sound[name]), []
    if rng.random() < 0.2 and name == "walk.mcap":
        odd, at = one_of(rng, ODD), int(rng.integers(19))
        (place / "made").mkdir()
        files = {name: write_bag(place / "made" / name, told(odd, at)).read_bytes()}
        words.append(f"{odd} in message {at + 1}")
    for _ in range(int(rng.integers(1, 3)) if not words else 0):
        if not files:
            break
        one = one_of(rng, sorted(files))
        content = files[one]
        if rng.random() < 0.1 or not isinstance(content, bytes):
            what, files = replaced(rng, files, one)
        else:
            what, data = one_of(rng, WAYS)(rng, content)
            what, files = f"{one}: {what}", files | {one: data}
        words.append(what)
    lay(files, place / "in")
    before = contents(place / "in")
    bag = "in" if name == "folder" else f"in/{name}"
    manner = one_of(rng, MANNERS)
    if not any(word in manner for word in ("--truth", "--topics")):
        manner = (*manner, "--bag.odometry", "/odom")
    line = ("slam", bag, "--quiet", "-o", "out", "--filter", "ekf", *manner)
    ending = command(place, *line, before=undrawn)
    faults = faults_of(ending, [bag, *files])
    faults += lost(before, contents(place / "in"), "a file of the bag")
    status = ending.found if ending.how == "returned" and "--topics" not in manner else None
    faults += unsound_results(place / "out", status)
    return Tried(told=tuple(words), endings=(ending,), faults=tuple(faults))
