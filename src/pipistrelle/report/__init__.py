"""A study as one readable page: the answer, the paper's claims judged, its figures, its numbers.

`tables` reads a study's folder into the arrays of `outcomes`; `families` words the paper's claims
as statements about means over worlds, from the `contrasts` of cases, and `claims` judges them;
`charts`, `timelines` and `models` lay figures out, `vector` draws them for the page and
`pipistrelle.figures.paper` for print; `page` writes it all.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "claims": ["judge_claims"],
        "outcomes": ["Study"],
        "page": ["write_report"],
        "tables": ["read_study"],
    },
)
