"""A study as one readable page: the answer, the paper's claims judged, its figures, its numbers.

`tables` reads a study's folder into the arrays of `outcomes`; `families` words the paper's claims
as statements about means over worlds, from the `contrasts` of cases, and `claims` judges them;
`charts`, `timelines` and `models` lay figures out, `vector` draws them for the page and
`pipistrelle.figures.paper` for print; `page` writes it all.
"""

from importlib import import_module

_DOOR = {
    "Study": "outcomes",
    "judge_claims": "claims",
    "read_study": "tables",
    "write_report": "page",
}
__all__ = list(_DOOR)


def __getattr__(name: str) -> object:
    if name not in _DOOR:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_DOOR[name]}"), name)
