"""`pipistrelle run`, `slam`, `hear` and `config`: missions, recorded logs and sound, settings."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import READERS, ROS_BAG
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.refusals import refusal
from pipistrelle.scripting import arguments, hearing, results
from pipistrelle.scripting.arguments import GATE_KEY, TIMING, is_open, mission_settings
from pipistrelle.settings import Layer, resolve
from pipistrelle.verbs.console import closing_table, progress, text_table
from pipistrelle.verbs.options import door_of, setting_flags, switch, verb_of
from pipistrelle.verbs.streams import put, say, warn

HEADS = ("topic", "type", "messages", "from [s]", "to [s]", "rate [Hz]", "taken for")
"""Columns of the table of a ROS bag."""
OPTIONS = {
    "filters": ("CHOICE", "that of the settings, of best the smoother"),
    "beamwidth": ("DEG", "33.3"),
    "landmarks": ("N", "50"),
    "duration": ("SECONDS", "187.5"),
    "particles": ("N", "100"),
    "world": ("DIR", "a random one"),
    "output": ("DIR", "runs/TIME-NAME"),
    "animate": ("", ""),
    "save_log": ("DIR", ""),
    "save_world": ("DIR", ""),
    "save_sound": ("DIR", ""),
    "frames": ("A:B", "all"),
}
"""Placeholders and defaults of options in the help."""
SLAM_OPTIONS = OPTIONS | {
    "filters": ("CHOICE", "that of the settings, else smoother"),
    "beamwidth": ("DEG", ""),
    "gate": ("P", "that of the log, else that of the estimator"),
    "robot": (
        "N|NAME",
        "",
        f"The robot of {', or of '.join(r.robot_help for r in READERS if r.robots)}.",
    ),
    "log": ("", "", f"The log: {', or '.join(reader.help for reader in READERS)}."),
    "truth": ("TOPIC", ""),
}
QUIET = switch("quiet", "Print only the result folder.")
MISSION = ("config", "beamwidth", "landmarks", "duration", "particles", "world")
"""Parameters of `run` that affect the settings."""


@contextmanager
def working(quiet: bool, *kernels: Any) -> Iterator[Callable[..., None]]:
    """Yield a function that shows progress; announce kernel compilation unless `quiet`.

    `kernels`: the settings and the estimators of kernels to compile first, in two processes.
    """
    from pipistrelle.experiments.runs.compiling import in_two_processes
    from pipistrelle.jit import announce

    tell = None if quiet else say
    announce(tell)
    compiled = in_two_processes(tell, *kernels) if kernels else nullcontext()
    with compiled, progress(quiet) as show:
        yield show


def _run(asked: dict[str, Any]) -> int:
    """Simulate a mission for `pipistrelle run`; print its scores and its folder."""
    door = door_of(asked, working=partial(working, asked["quiet"]))
    return _delivered(results.run_by(door), asked["quiet"])


def _slam(asked: dict[str, Any]) -> int:
    """Solve a log for `pipistrelle slam`; print scores and folder, or the topics of a bag."""
    door = door_of(asked, working=partial(working, asked["quiet"]))
    if asked["topics"]:
        return _list_topics(asked["log"], over_named(door.beneath)[0] | door.flags | door.short())
    return _delivered(results.slam_by(door), asked["quiet"])


def _delivered(done: results.Results, quiet: bool) -> int:
    """Print a mission's scores and folder; return exit status 1 if an estimate failed, else 0."""
    from pipistrelle.scripting.missions import failures, strategy_names

    mission = done.mission
    if not quiet:
        put(closing_table(mission, strategy_names(mission)))
    failed = failures(mission)
    warn(*failed)
    put(done.folder)
    return 1 if failed else 0


def _list_topics(path: Path, layer: Layer) -> int:
    """Print the topics of a ROS bag with their roles and their times of reception."""
    from pipistrelle.detection.logs.bag import Topic, opened
    from pipistrelle.detection.logs.bag_log import roles

    settings = resolve(layer).bag
    if not ROS_BAG.recognises(path):
        fix = "leave out --topics"
        raise refusal(f"{path}, option --topics", "no ROS bag by its name", "one", fix)
    with opened(path) as bag:
        topics = bag.seen()
    taken = roles(topics, settings)

    def row(topic: Topic) -> list[str]:
        first, last = topic.span if topic.span and topic.count else (0.0, 0.0)
        rate = f"{(topic.count - 1) / (last - first):.4g}" if last > first else ""
        span = [f"{first:.3f}", f"{last:.3f}"] if topic.count else ["", ""]
        words = topic.name, topic.type, str(topic.count), *span, rate, taken[topic.name]
        return [repr(word)[1:-1] for word in words]

    put(text_table("", [HEADS], [row(topic) for topic in topics]))
    return 0


def _hear(asked: dict[str, Any]) -> int:
    """Detect the echoes of a recording for `pipistrelle hear`, or check the recording."""
    recording, door = asked["recording"], door_of(asked, working=partial(working, asked["quiet"]))
    config = hearing.heard_settings(door.flags)
    about = hearing.described(recording)
    if asked["check"]:
        from pipistrelle.detection.sounds.check import check_recording

        faults = check_recording(recording, about, config)
        put("\n".join(faults) or "nothing odd was found")
        if faults:
            warn(f"{recording}: found {len(faults)} fault{'s' * (len(faults) > 1)}")
        return 1 if faults else 0
    if asked["output"] is None:
        raise InputError("hear: found no folder for the log; name one with -o LOG")
    heard = hearing.hear_by(door)
    if outside := heard.log.rows - heard.log.inside:
        warn(f"{recording}: {outside} rows are before or after the odometry, and left out by slam")
    if not asked["quiet"]:
        put(f"{heard.log.rows} rows; for slam add --association.method marginal")
    put(heard.folder)
    return 0


def _show(asked: dict[str, Any]) -> None:
    """Print the settings of a mission as TOML."""
    import numpy as np

    from pipistrelle.acoustics.paths import callers_of
    from pipistrelle.arrays.sampling import sampling
    from pipistrelle.settings import to_toml

    config, _, _ = mission_settings(door_of(asked))
    callers = callers_of(config, np.zeros(2))[: 2 if config.callers is None else 1]
    sampling(config, callers)  # raises for sample rates and frequencies that `run` rejects
    put(to_toml(config), end="")


def schema() -> None:
    """Print the JSON schema of the settings, for editors that check TOML."""
    put(json.dumps(Config.model_json_schema(), indent=2))


_ALL = setting_flags()
run = verb_of(results.run, _run, settings=_ALL, options=OPTIONS, extra=[QUIET])
show = verb_of(results.run, _show, settings=_ALL, options=OPTIONS, only=MISSION)
slam = verb_of(
    results.slam,
    _slam,
    settings=setting_flags(
        lambda key: is_open(key) and key != GATE_KEY,
        arguments.OWN | {TIMING: "where the log has excess paths, or a caller that moves"},
    ),
    options=SLAM_OPTIONS,
    extra=[
        switch("topics", "List the topics of a ROS bag and their roles; do nothing else."),
        QUIET,
    ],
)
hear = verb_of(
    hearing.hear,
    _hear,
    settings=setting_flags(hearing.is_heard),
    options={"frames": ("A:B", "all"), "output": ("LOG", "")},
    extra=[
        switch(
            "check",
            "Look for faults instead: silent or clipped channels, a wrong sample rate, calls that "
            "jump, exchanged channels and faces.",
        ),
        switch("quiet", "Print only the folder of the log."),
    ],
)
