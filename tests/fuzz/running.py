"""An action in a child process: whatever becomes of it harms nobody, and how it ended is told."""

import faulthandler
import os
import pickle
import resource
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO, Literal, NoReturn

LIMIT = 10.0
"""What takes longer hangs [s]; a sound command takes a fifth of one."""
MEMORY = 4 << 30
"""Bytes that a child may have."""
RAISED = 70
HUNG = "Timeout (0:"
"""What Python's watchdog says first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """How an action ended."""

    how: Literal["returned", "raised", "hung", "died"]
    found: Any
    words: tuple[str, ...]
    printed: str
    said: str


def command(
    place: Path, *words: str, before: Callable[[], None] = lambda: None, limit: float = LIMIT
) -> Ending:
    """Obey a command line in a child."""

    def obey() -> int:
        before()
        sys.argv = ["pipistrelle", *words]
        from pipistrelle.__main__ import main

        return main(words)

    return end_of(obey, place, words, limit)


def made(place: Path, *words: str, limit: float) -> None:
    """Obey a command line without pictures in a child; it must succeed."""
    ending = command(place, *words, before=undrawn, limit=limit)
    if ending.how != "returned" or ending.found != 0:
        raise RuntimeError(f"{words} ends with {ending}")


def end_of(
    action: Callable[[], Any], place: Path, words: Sequence[str] = (), limit: float = LIMIT
) -> Ending:
    """Do something in a child, within limits of time and memory."""
    with TemporaryFile() as printed, TemporaryFile() as said, TemporaryFile() as found:
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            _do(action, place, limit, printed, said, found)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        texts = [_all(file).decode(errors="backslashreplace") for file in (printed, said)]
        returned = _all(found)
    hung = code == 1 and HUNG in texts[1]
    return Ending(
        how="returned" if code == 0 else "raised" if code == RAISED else "hung" if hung else "died",
        found=pickle.loads(returned) if code == 0 else code,
        words=tuple(words),
        printed=texts[0],
        said=texts[1],
    )


def _do(
    action: Callable[[], Any],
    place: Path,
    limit: float,
    printed: BinaryIO,
    said: BinaryIO,
    found: BinaryIO,
) -> NoReturn:
    """Be the child."""
    code = RAISED
    try:
        _redirect(printed, said)
        os.chdir(place)
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.enable(file=sys.stderr)
        faulthandler.dump_traceback_later(limit, exit=True, file=sys.stderr)
        _warn_as_usual()
        pickle.dump(action(), found)
        found.flush()
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _redirect(printed: BinaryIO, said: BinaryIO) -> None:
    """Send what is printed and said into files, and have nothing to read."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(printed.fileno(), 1)
    os.dup2(said.fileno(), 2)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - a descriptor
    sys.stderr = open(  # noqa: SIM115 - a descriptor
        2, "w", buffering=1, closefd=False, errors="backslashreplace"
    )


def _warn_as_usual() -> None:
    """Show the warnings that a person would be shown."""
    warnings.resetwarnings()
    for hidden in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", hidden)


def _all(file: BinaryIO) -> bytes:
    """Read a file from its beginning."""
    file.seek(0)
    return file.read()


def load_all() -> None:
    """Load the kernels and all that a command imports, for the children to inherit.

    Polars is imported and not used: its threads would not follow into a child.
    """
    import matplotlib  # noqa: F401
    import polars  # noqa: F401
    import pydantic.dataclasses
    import pydantic.type_adapter  # noqa: F401
    import tomli_w  # noqa: F401

    import pipistrelle.experiments.runs.replay
    import pipistrelle.experiments.studies.study
    import pipistrelle.figures.mission
    import pipistrelle.figures.style
    import pipistrelle.report.page
    import pipistrelle.verbs.missions  # noqa: F401
    from pipistrelle.__main__ import main
    from pipistrelle.experiments.runs.compiling import compile_kernels

    compile_kernels()
    with redirect_stderr(StringIO()):
        for words in ("slam nowhere", "run --duration nan", "study nowhere", "report nowhere"):
            main(words.split())


def undrawn() -> None:
    """Leave out the pictures, which are most of a short command's time."""
    from pipistrelle.experiments.runs import compiling
    from pipistrelle.figures import mission, style
    from pipistrelle.report import page

    mission.draw_mission = lambda *_, **__: None
    style.save_figure = lambda *_: None
    page._write_figure = lambda *_: None
    compiling.compile_kernels = lambda *_: None
