"""The verbs of the command line, how one is run, and how mistakes in it are reported."""

from collections.abc import Sequence
from errno import ENOSPC
from inspect import Parameter, signature
from itertools import pairwise, zip_longest
from pathlib import Path

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from pipistrelle.detection.logs.readers import recording_of
from pipistrelle.verbs.streams import flush_results, say
from pipistrelle.version import find_version

SPELLINGS = (
    "A setting is --rays.power 3 as a flag, PIPISTRELLE_RAYS__POWER=3 in the environment and "
    "power = 3 under [rays] in FILE.toml; flags go before the environment, that before the file, "
    "that before settings by name."
)

FILMS = ("gif", "mp4")
SHORT = {"scenario.steps": "duration", "emitter.radius": "beamwidth"}
"""Settings that some verbs also take by a short name of another meaning."""

app = App(
    name="pipistrelle",
    help="Sonar SLAM with one's own calls, someone else's, or both: from waveform to verdict.",
    version=find_version,
    help_format="plaintext",
    exit_on_error=False,
    print_error=False,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
app.command(
    "pipistrelle.verbs.run:run",
    name="run",
    help="Drive through one random world, by sound; the three strategies side by side.",
    help_epilogue=SPELLINGS,
)
app.command(
    "pipistrelle.verbs.slam:slam",
    name="slam",
    help="Solve a recorded log: a log folder, or a UTIAS MRCLAM folder as it is.",
    help_epilogue=SPELLINGS,
)
app.command(
    "pipistrelle.verbs.hear:hear",
    name="hear",
    help="Hear a sound recording of an array of microphones into a log, for slam.",
)
app.command(
    "pipistrelle.verbs.view:view",
    name="view",
    help="Play a mission in a browser, frame by frame: one page, which asks for nothing outside.",
)
app.command(
    "pipistrelle.verbs.study:study",
    name="study",
    help="Run many worlds, and all that a plan varies in each; again on one folder: go on.",
    help_epilogue=SPELLINGS,
)
app.command(
    "pipistrelle.verbs.report:report",
    name="report",
    help="Put a study on one page: the answer to its question, its figures and its numbers; for a "
    "plan of the paper's, its claims judged.",
)
app.command(
    "pipistrelle.verbs.compare:compare",
    name="compare",
    help="Put results side by side: scores, paths and settings of runs, logs or studies.",
)
app.command(
    "pipistrelle.verbs.array:array",
    name="array",
    help="Draw a microphone array, and say what it can tell of a bearing and what it cannot.",
)
config = App(name="config", help="Show the settings, or what a file of settings may hold.")
config.command(
    "pipistrelle.verbs.config:show",
    name="show",
    help="Print the settings of `run` as TOML: defaults < named < file < environment < flags.",
    help_epilogue=SPELLINGS,
)
config.command(
    "pipistrelle.verbs.config:schema", name="schema", help="Print the settings' JSON schema."
)
app.command(config)
app.command(
    "pipistrelle.verbs.doctor:doctor",
    name="doctor",
    help="Say what is installed here, and how to fix what is missing.",
)


def obey(words: Sequence[str], heard: Sequence[int] = ()) -> int:
    """Run a command line and return its exit status; report mistakes of the user in a line.

    `heard` collects the signals that ask for an end: after one, an error is no mistake of the user.
    """
    try:
        _refuse_empty(words)
        _refuse_sections(words)
        status = app(_completed(words)) or 0
        flush_results()
    except SystemExit:  # help, whose reader has left
        return 0
    except (CycloptsError, OSError, ValueError, MemoryError) as error:
        message = _explained(error, words)
        if message is None or heard:
            raise
        for line in message.splitlines():
            say(f"pipistrelle: error: {line}")
        return 2
    return status


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuse an empty argument, which as a path would be the current folder."""
    for before, word in pairwise(("pipistrelle", *words)):
        flag, given, value = word.partition("=")
        if not word or (flag.startswith("-") and given and not value):
            from pipistrelle.config import InputError

            where = flag if given else before
            raise InputError(
                f"{where}: found '', expected a value (for the folder that you are in: .)"
            )


def _refuse_sections(words: Sequence[str]) -> None:
    """Refuse a value for a whole section of settings: it would be that of its first setting."""
    names = [word.partition("=")[0] for word in words if word.startswith("--")]
    if not names or {"--help", "--version"} & {*names}:  # which load no settings
        return
    from pipistrelle.config import InputError

    sections = _sections()
    for name in names:
        if name[2:] in sections:
            first = next(iter(sections[name[2:]]))
            raise InputError(f"{name}: is a section of settings; name one of it, as {name}.{first}")


def _sections() -> dict[str, list[str]]:
    """Return the settings of each section; --filter is an option, too."""
    from pipistrelle.settings import known_settings

    found: dict[str, list[str]] = {}
    for section, *rest in known_settings():
        if rest and section != "filter":
            found.setdefault(section, []).append(rest[0].replace("_", "-"))
    return found


def _completed(words: Sequence[str]) -> list[str]:
    """Give a bare ``--animate`` its format."""
    return [
        "--animate=gif" if word == "--animate" and after not in FILMS else word
        for word, after in zip_longest(words, words[1:])
    ]


def _explained(error: Exception, words: Sequence[str]) -> str | None:
    """Return the message for a user's mistake; None for a bug."""
    from pipistrelle.config import InputError

    if isinstance(error, MemoryError):
        return (
            f"not enough memory ({error}); ask for a shorter drive (scenario.steps), fewer "
            "landmarks (scenario.landmarks) or fewer particles (fastslam.particles)"
        )
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, OSError) and error.errno == ENOSPC:  # a full disk behind our output
        return f"the output could not be written: {error.strerror}"
    if isinstance(error, UnknownOptionError):
        return _unknown(error)
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens and error.target:
        return _too_many(error, error.unused_tokens[0], words)
    if isinstance(error, MissingArgumentError) and error.keyword and error.argument:
        expected = error.argument.token_count()[0]
        if expected > 1:
            found = len(error.tokens_so_far) % expected
            return f"{error.keyword}: found {found} values, expected {expected}"
    argument = getattr(error, "argument", None)
    if isinstance(error, CycloptsError) and argument and argument.name not in str(error):
        return f"{argument.name}: {error}"
    return str(error) if isinstance(error, (CycloptsError, InputError)) else None


def _unknown(error: UnknownOptionError) -> str:
    """Name the option that was probably meant: spelt alike, or ending in the same part."""
    from pipistrelle.refusals import meant

    word = (error.token.keyword or error.token.value).partition("=")[0]
    names = {name[2:] for argument in error.argument_collection for name in argument.names}
    known, wanted = sorted(names - _sections().keys()), word.lstrip("-").replace("_", "-")
    same = [name for name in known if wanted in (name.partition(".")[2], SHORT.get(name))]
    near = same[0] if same else meant(wanted, known)
    return f"Unknown option: {word}. " + (f"Did you mean --{near}?" if near else "See --help.")


def _too_many(error: UnusedCliTokensError, word: str, words: Sequence[str]) -> str:
    """Return the message for an argument that no option takes."""
    if ("--animate", word) in pairwise(words):
        return f"--animate: found {word!r}, expected {' or '.join(FILMS)}"
    verb, kinds = " ".join(error.command_chain or ()), signature(error.target or obey).parameters
    takes = sum(kind.kind is Parameter.POSITIONAL_ONLY for kind in kinds.values())
    if verb == "run" and (what := recording_of(Path(word))):
        return f"run: found {word!r}, {what}; run makes up its own sound, and slam solves a log"
    most = "no arguments" if not takes else "one argument" if takes == 1 else f"{takes} arguments"
    return f"{verb}: found {word!r}, but {verb} takes {most}; options begin with --"
