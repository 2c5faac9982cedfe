"""`pipistrelle study`: all cases of a plan in many worlds."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import Parameter as Argument
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from pipistrelle.config import InputError
from pipistrelle.experiments.named_settings import PLANS
from pipistrelle.scripting import studies
from pipistrelle.verbs.console import bars
from pipistrelle.verbs.options import NamedSettings, layers, setting_flags, switch, verb_of
from pipistrelle.verbs.streams import put, say, warn

if TYPE_CHECKING:
    from pipistrelle.experiments.studies.plan import Plan
    from pipistrelle.experiments.studies.study import StudyProgress

Show = Callable[["StudyProgress"], None]


def _study(asked: dict[str, Any]) -> int:
    """Run a study for `pipistrelle study`; print counts of worlds and trials, and the folder."""
    from pipistrelle.experiments.studies.plan import MOST_WORLDS, find_plan, read_plan

    iterations, workers, quiet = asked["iterations"], asked["workers"], asked["quiet"]
    scheduler = asked["scheduler"]
    for flag, number in (("--iterations", iterations), ("--workers", workers)):
        if number is not None and not 1 <= number <= MOST_WORLDS:
            raise InputError(f"{flag}: found {number}, expected 1 to {MOST_WORLDS}")
    if workers is not None and scheduler not in (None, "local"):
        raise InputError(f"--workers: the cluster at {scheduler} has its own; leave it out")
    share, layer = _share(asked["shard"]), layers(asked["config"], asked["settings"])
    plan = read_plan(find_plan(asked["plan"]), layer, iterations)
    folder = asked["output"] or Path("runs") / plan.name
    from pipistrelle.experiments.machine import cores
    from pipistrelle.experiments.studies.study import run_study, warnings_of_plan

    warn(*warnings_of_plan(plan))
    try:
        with _progress(quiet) as show:
            so_far = run_study(
                plan,
                folder,
                workers=workers or cores(),
                shard=share,
                scheduler=scheduler,
                retry_failed=asked["retry_failed"],
                progress=show if scheduler else _compiled_first(plan, show, quiet),
            )
    except KeyboardInterrupt:
        say(f"{folder}: worlds that are done are kept; the same command goes on with the rest")
        raise
    ended, failed = sum(so_far.ended.values()), sum(so_far.failed.values())
    if not quiet:
        worlds = f"{so_far.done} world{'s' * (so_far.done != 1)}"
        put(f"{worlds}, {ended} trial{'s' * (ended != 1)}, {failed} failed")
    if failed:
        warn(
            f"{failed} of {ended} trials failed, the first with: "
            f"{so_far.first_error}; see the column error in {folder / 'trials'}; "
            "--retry-failed does their worlds again"
        )
    put(folder)
    return 1 if failed else 0


def _share(text: str | None) -> tuple[int, int]:
    """Parse an option I/N, which selects every N-th world from world I on."""
    i, slash, n = (text or "0/1").partition("/")
    if slash and i.isdecimal() and n.isdecimal() and int(i) < int(n):
        return int(i), int(n)
    raise InputError(f"--shard: found {text!r}, expected I/N with I from 0 to N - 1, as in 0/4")


def _compiled_first(plan: "Plan", show: Show, quiet: bool) -> Show:
    """Return a progress function that compiles a plan's kernels when it is first called."""
    ready = False

    def prepare(so_far: "StudyProgress") -> None:
        nonlocal ready
        if not ready and so_far.done < so_far.worlds:
            from pipistrelle.experiments.runs.compiling import compile_kernels, in_two_processes
            from pipistrelle.experiments.studies.plan import cases_of

            cases, tell = cases_of(plan), None if quiet else say
            if tell and plan.config.settings is None and plan.name not in PLANS:
                tell('The paper\'s settings are used; `settings = "best"` gives those of `run`.')
            timings = {case.config.listening.excess_paths for case in cases}
            with in_two_processes(tell, cases[0].config, plan.filters):
                compile_kernels(plan.filters, sorted(timings))
        ready = True
        show(so_far)

    return prepare


@contextmanager
def _progress(quiet: bool) -> Iterator[Show]:
    """Yield a function that shows a study's progress: bars on a terminal, else lines.

    A line is printed first, last and every ten seconds.
    """
    pace, due = _pace(), 0.0
    with bars(quiet, 8) as draw:

        def show(so_far: "StudyProgress") -> None:
            nonlocal due
            left = pace(so_far)
            worlds, rest = f"{so_far.done}/{so_far.worlds}", f", {left}" if left else ""
            trials = {
                name: f"{ended}/{so_far.trials[name]}" + f" ({failed} failed)" * (failed > 0)
                for (name, ended), failed in zip(
                    so_far.ended.items(), so_far.failed.values(), strict=True
                )
            }
            if draw is not None:
                draw("worlds", so_far.done, so_far.worlds, worlds + rest)
                for name, text in trials.items():
                    draw(name, so_far.ended[name], so_far.trials[name], text)
            elif not quiet and (perf_counter() >= due or so_far.done == so_far.worlds):
                due = perf_counter() + 10.0
                ended = ", ".join(f"{name} {text}" for name, text in trials.items())
                say(f"{worlds} worlds{rest}; trials: {ended}")

        yield show


def _pace() -> Callable[["StudyProgress"], str]:
    """Return a function that formats a study's speed and the remaining time."""
    began: tuple[float, int] | None = None

    def pace(so_far: "StudyProgress") -> str:
        nonlocal began
        ended, total = sum(so_far.ended.values()), sum(so_far.trials.values())
        began = began or (perf_counter(), ended)
        elapsed, since = perf_counter() - began[0], ended - began[1]
        if not since or elapsed <= 0.0:
            return ""
        return f"{since / elapsed:.1f} trials/s, {_span((total - ended) * elapsed / since)} left"

    return pace


def _span(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    minutes = round(seconds / 60.0)
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


study = verb_of(
    studies.study,
    _study,
    settings=setting_flags(),
    options={
        "plan": ("", "", f"{', '.join(PLANS)}, or a FILE.toml like the plan.toml of a study."),
        "iterations": ("N", "that of the plan"),
        "workers": ("N", "one per core", "Number of processes."),
        "shard": ("I/N", "all", "Run only the I-th of N shares, from 0 on."),
        "output": ("DIR", "runs/NAME"),
        "scheduler": ("ADDRESS", ""),
    },
    extra=[
        Argument("config", Argument.KEYWORD_ONLY, default=None, annotation=NamedSettings),
        switch("quiet", "Print only the folder of the study."),
    ],
)
