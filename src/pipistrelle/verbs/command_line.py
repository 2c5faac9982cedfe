"""The verbs of the command line, and messages for mistakes in it."""

import warnings
from collections.abc import Sequence
from errno import ENOSPC
from inspect import Parameter as Argument
from inspect import signature
from itertools import pairwise, zip_longest
from pathlib import Path

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    UnknownOptionError,
    UnusedCliTokensError,
)

from pipistrelle.verbs.streams import flush_results, say, warn
from pipistrelle.version import find_version

SPELLINGS = (
    "--help-all lists all settings. A setting is --rays.merge 3 as a flag, "
    "PIPISTRELLE_RAYS__MERGE=3 in the environment and merge = 3 under [rays] in FILE.toml; flags "
    "override the environment, that a file, and that settings by name."
)

FILMS, EVERYTHING = ("gif", "mp4"), "--help-all"
SEVERAL = ("--filter", "--estimator", "--strategy")
"""Options that may have several values."""
NAMED: set[str] = set()
"""First part of each option of the current command line, up to a dot."""
SHORT = {"scenario.steps": "duration", "emitter.radius": "beamwidth"}
"""Settings with a short option of another meaning."""

app = App(
    name="pipistrelle",
    help="Sonar SLAM with the calls of a vehicle, of other emitters, or both.",
    version=find_version,
    help_format="plaintext",
    exit_on_error=False,
    print_error=False,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
    default_parameter=Parameter(
        negative=(), show_default=lambda value: str(value) if value else None
    ),
)
config = App(name="config", help="Print the settings, or their schema.")
for parent, name, place, words in (
    (app, "run", "missions", "Simulate a drive through a random world and map it."),
    (app, "slam", "missions", "Solve a recorded log: a log folder, ROS bag or MRCLAM folder."),
    (app, "hear", "missions", "Detect the echoes in a sound recording, as a log for slam."),
    (app, "look", "view", "Describe a log, ROS bag or sound recording before it is solved."),
    (app, "view", "view", "Play a mission in a browser, on one page that needs no network."),
    (app, "study", "study", "Run all cases of a plan in many worlds, or continue a study."),
    (app, "report", "compare", "Write a study as one page: answer, figures, claims."),
    (app, "compare", "compare", "Compare the results of runs, logs or studies."),
    (app, "array", "view", "Draw a microphone array; print its ambiguous bearings."),
    (config, "show", "missions", "Print the settings of `run` as TOML."),
    (config, "schema", "missions", "Print the JSON schema of the settings."),
    (app, "doctor", "doctor", "Check the installation, and print the fix of each problem."),
):
    epilogue = SPELLINGS if name in ("run", "slam", "hear", "study", "show") else None
    verb = f"pipistrelle.verbs.{place}:{name}"
    parent.command(verb, name=name, help=words, help_epilogue=epilogue)
app.command(config)


def obey(words: Sequence[str], heard: Sequence[int] = ()) -> int:
    """Run a command line and return its exit status; print a message for a user's mistake.

    `heard` collects signals to end; after the first, an error is not a mistake of the user.
    """
    NAMED.clear()
    NAMED.update(word.lstrip("-").partition(".")[0] for word in words if word[:1] == "-")
    words = ["--help" if word == EVERYTHING else word for word in words]
    try:
        _refuse_empty(words)
        _refuse_sections(words)
        completed = [  # a bare --animate is of a GIF
            "--animate=gif" if word == "--animate" and after not in FILMS else word
            for word, after in zip_longest(words, words[1:])
        ]
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: warn(str(message))
            status = app(completed) or 0
        flush_results()
    except SystemExit:  # help, if its reader has left
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
    """Raise for an empty argument, which would be taken for the current folder."""
    for before, word in pairwise(("pipistrelle", *words)):
        flag, given, value = word.partition("=")
        if not word or (flag.startswith("-") and given and not value):
            from pipistrelle.config import InputError

            expected = "a value (for the folder that you are in: .)"
            raise InputError(f"{flag if given else before}: found '', expected {expected}")


def _refuse_sections(words: Sequence[str]) -> None:
    """Raise for an option that gives a value to a whole section of settings."""
    names = [word.partition("=")[0] for word in words if word.startswith("--")]
    if not names or {"--help", "--version"} & {*names}:  # these load no settings
        return
    from pipistrelle.config import InputError
    from pipistrelle.settings import known_settings

    for name in names:
        leaves = [key[1] for key in known_settings() if key[0] == name[2:] and key[1:]]
        if leaves and name != "--filter":
            first = f"{name}.{leaves[0].replace('_', '-')}"
            raise InputError(f"{name}: is a section of settings; name one of it, as {first}")


def _explained(error: Exception, words: Sequence[str]) -> str | None:
    """Return the message for an error that is a user's mistake; None for a bug."""
    from pipistrelle.config import InputError

    if isinstance(error, MemoryError):
        return (
            f"not enough memory ({error}); ask for a shorter drive (scenario.steps), fewer "
            "landmarks (scenario.landmarks) or fewer particles (fastslam.particles)"
        )
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, OSError) and error.errno == ENOSPC:  # standard output on a full disk
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
    """Return the message for an unknown option, with the most similar known option."""
    from pipistrelle.refusals import meant
    from pipistrelle.settings import RENAMED, known_settings

    word = (error.token.keyword or error.token.value).partition("=")[0]
    names = {name[2:] for argument in error.argument_collection for name in argument.names}
    keys = (*map(".".join, known_settings()), *RENAMED)
    names |= {key.replace("_", "-") for key in keys}
    names -= {key[0] for key in known_settings() if key[1:] and key[0] != "filter"}
    known, wanted = sorted(names), word.lstrip("-").replace("_", "-")
    same = [name for name in known if wanted in (name.partition(".")[2], SHORT.get(name))]
    near = same[0] if same else meant(wanted, known) or ""
    near = RENAMED.get(near.replace("-", "_"), near).replace("_", "-")
    return f"Unknown option: {word}. " + (f"Did you mean --{near}?" if near else "See --help.")


def _too_many(error: UnusedCliTokensError, word: str, words: Sequence[str]) -> str:
    """Return the message for an argument that a command does not take."""
    if ("--animate", word) in pairwise(words):
        return f"--animate: found {word!r}, expected {' or '.join(FILMS)}"
    verb, kinds = " ".join(error.command_chain or ()), signature(error.target or obey).parameters
    takes = sum(kind.kind is Argument.POSITIONAL_ONLY for kind in kinds.values())
    if verb == "run":
        from pipistrelle.detection.logs.readers import kind_of, wrong_kind

        if kind_of(Path(word)):
            return str(wrong_kind(Path(word), "no argument, as run simulates a drive", ""))
    most = "no arguments" if not takes else "one argument" if takes == 1 else f"{takes} arguments"
    joined = ", and commas join their values" * any(one in SEVERAL for one in words)
    return f"{verb}: found {word!r}, but {verb} takes {most}; options begin with --{joined}"
