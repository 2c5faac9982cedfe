"""`pipistrelle run`, `slam` and `config`: simulated missions, recorded logs, settings."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipistrelle.config import Config
from pipistrelle.detection.logs.readers import READERS, ROS_BAG
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.refusals import refusal
from pipistrelle.scripting import arguments, results
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
    "engine": ("", "auto"),
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
MISSION = ("config", "beamwidth", "landmarks", "duration", "engine", "particles", "world")
"""Parameters of `run` that affect the settings."""


def _run(asked: dict[str, Any]) -> int:
    """Simulate a mission; print its scores and its folder."""

    @contextmanager
    def working(config: Config, filters: Sequence[str]) -> Iterator[Callable[..., None]]:
        from pipistrelle.experiments.runs.compiling import in_two_processes
        from pipistrelle.kernel_clock import announce

        announce(None if asked["quiet"] else say)
        with (
            in_two_processes(None if asked["quiet"] else say, config, filters),
            progress(asked["quiet"]) as show,
        ):
            yield show

    return _delivered(results.run_by(door_of(asked, working=working)), asked["quiet"])


def _slam(asked: dict[str, Any]) -> int:
    """Solve a log; print its scores and its folder, or the topics of a bag."""

    @contextmanager
    def working() -> Iterator[Callable[..., None]]:
        from pipistrelle.kernel_clock import announce

        announce(None if asked["quiet"] else say)
        with progress(asked["quiet"]) as show:
            yield show

    door = door_of(asked, working=working)
    if asked["topics"]:
        return _list_topics(asked["log"], over_named(door.beneath)[0] | door.flags | door.short())
    return _delivered(results.slam_by(door), asked["quiet"])


def _delivered(done: results.Results, quiet: bool) -> int:
    """Print the table and the folder of a mission; return 1 if an estimate failed, else 0."""
    from pipistrelle.scripting.log_warnings import distance_driven
    from pipistrelle.scripting.missions import failures, strategy_names

    mission = done.mission
    if not quiet:
        landmarks, log = mission.drive.truth.landmarks, mission.log
        count = None if landmarks is None else len(landmarks[0])
        driven = None if log is None else distance_driven(log)
        put(closing_table(mission.trials, count, driven, strategy_names(mission)))
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
