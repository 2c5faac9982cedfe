"""`pipistrelle hear`: a sound recording to a log."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from pipistrelle.config import InputError
from pipistrelle.files import LOG, claim
from pipistrelle.scripting.hearing import described, faults_of, heard_into, heard_settings, is_heard
from pipistrelle.settings import from_flags
from pipistrelle.verbs.console import progress
from pipistrelle.verbs.options import setting_flags
from pipistrelle.verbs.streams import put, warn

if TYPE_CHECKING:
    HearFlags = dict[str, Any]
else:
    HearFlags = setting_flags(is_heard)


def hear(
    recording: Annotated[
        Path,
        Parameter(
            help="A folder of sound files, recording.toml, array.csv and odometry.csv, perhaps "
            "calls.csv."
        ),
    ],
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(name=("--output", "-o"), metavar="LOG", help="The log's folder."),
    ] = None,
    overwrite: Annotated[bool, Parameter(negative=(), help="Replace an earlier log in LOG.")] = (
        False
    ),
    frames: Annotated[
        str | None,
        Parameter(
            metavar="A:B",
            help="Only the calls from number A, counted from 0, to before B. [default: all]",
        ),
    ] = None,
    check: Annotated[
        bool,
        Parameter(
            negative=(),
            help="Look for mistakes instead: dead or clipped channels, a wrong sample rate, calls "
            "that jump, channels and faces in another order.",
        ),
    ] = False,
    quiet: Annotated[bool, Parameter(negative=(), help="Print the log's folder alone.")] = False,
    settings: Annotated[HearFlags | None, Parameter(name="*")] = None,
) -> int:
    """Hear a sound recording into a log that `pipistrelle slam` solves."""
    config = heard_settings(from_flags(settings or {}))
    if check:
        faults = faults_of(recording, config)
        put("\n".join(faults) or "nothing odd was found")
        if faults:
            warn(f"{recording}: found {len(faults)} fault{'s' * (len(faults) > 1)}")
        return 1 if faults else 0
    described(recording)
    if output is None:
        raise InputError("hear: found no folder for the log; name one with -o LOG")
    own = claim(output, LOG, overwrite=overwrite, flags=("-o LOG", "--overwrite"))
    from pipistrelle.kernel_clock import announce
    from pipistrelle.verbs.streams import say

    announce(None if quiet else say)
    with progress(quiet) as show:
        heard = heard_into(own, recording, config, frames, "--frames", show)
    warn(*(f"{recording}: {line}" for line in heard.odd))
    outside = heard.log.rows - heard.log.inside
    if outside:
        warn(f"{recording}: {outside} rows are before or after the odometry, and left out by slam")
    if not quiet:
        put(f"{heard.log.rows} rows")
    put(own.folder)
    return 0
