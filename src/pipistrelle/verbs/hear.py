"""`pipistrelle hear`: the echoes of a sound recording as a log."""

from typing import Any

from pipistrelle.config import InputError
from pipistrelle.files import LOG, claim
from pipistrelle.scripting import hearing
from pipistrelle.settings import from_flags
from pipistrelle.verbs.console import progress
from pipistrelle.verbs.options import setting_flags, spell, switch, verb_of
from pipistrelle.verbs.streams import put, say, warn


def _hear(asked: dict[str, Any]) -> int:
    """Detect the echoes of a recording; print the number of rows and the folder of the log."""
    recording, output, quiet = asked["recording"], asked["output"], asked["quiet"]
    config = hearing.heard_settings(from_flags(asked["settings"] or {}))
    if asked["check"]:
        faults = hearing.faults_of(recording, config)
        put("\n".join(faults) or "nothing odd was found")
        if faults:
            warn(f"{recording}: found {len(faults)} fault{'s' * (len(faults) > 1)}")
        return 1 if faults else 0
    hearing.described(recording)
    if output is None:
        raise InputError("hear: found no folder for the log; name one with -o LOG")
    flags = (spell("output", "LOG"), spell("overwrite"))
    own = claim(output, LOG, overwrite=asked["overwrite"], flags=flags)
    from pipistrelle.kernel_clock import announce

    announce(None if quiet else say)
    with progress(quiet) as show:
        heard = hearing.heard_into(own, recording, config, asked["frames"], spell, show)
    warn(*(f"{recording}: {line}" for line in heard.odd))
    outside = heard.log.rows - heard.log.inside
    if outside:
        warn(f"{recording}: {outside} rows are before or after the odometry, and left out by slam")
    if not quiet:
        put(f"{heard.log.rows} rows")
    put(own.folder)
    return 0


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
