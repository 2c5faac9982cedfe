"""Try odd things, and tell which faults came of them: `./dev fuzz`."""

import sys
from collections.abc import Sequence
from typing import Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number

from fuzz.campaign import Found, campaign, grouped, report, try_again

app = App(
    name="./dev fuzz",
    help="Odd logs, settings, folders and deaths, by the thousand.",
    version_flags=(),
    default_parameter=Parameter(negative=()),
)


@app.default
def fuzz(
    target: Literal[
        "logs",
        "settings",
        "studies",
        "kills",
        "steps",
        "ownership",
        "results",
        "worlds",
        "bags",
        "sounds",
        "live",
    ],
    /,
    *,
    tries: Annotated[int, Parameter(validator=Number(gte=1))] = 100,
    seed: int = 1,
    only: int | None = None,
) -> int:
    """Make tries at a target.

    Parameters
    ----------
    target
        What is spoiled.
    tries
        How many.
    seed
        Of all of them.
    only
        Make the try of this number alone, and tell all of it.
    """
    if only is not None:
        tried = try_again(target, seed, only)
        print(report(tried))
        return 1 if tried.faults else 0
    found, ends = campaign(target, tries, seed, progress=_say)
    print(f"{target}: {tries} tries with seed {seed}, {len(found)} with faults")
    print(", ".join(f"{count} {end}" for end, count in ends.most_common()))
    for fault, numbers in grouped(found):
        shown = ", ".join(map(str, numbers[:3])) + (", ..." if len(numbers) > 3 else "")
        print(f"{len(numbers):>6}  {fault}  [--only {shown}]")
    return 1 if found else 0


def _say(done: int, tries: int, found: Sequence[Found]) -> None:
    """Say how far a campaign is."""
    print(f"{done}/{tries} tries, {len(found)} with faults", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(app(result_action="return_value"))
