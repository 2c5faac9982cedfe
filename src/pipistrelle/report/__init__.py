"""A study as one readable page: the answer, the paper's claims judged, its figures, its numbers.

`reading` lays a study's folder out as the arrays of `studied`; `claims` selects the worlds that
count, words and judges what the paper found; `charts` lays figures out; `page` writes it all.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "claims.contrasts": ["selections"],
        "claims.verdicts": ["judge_claims"],
        "page.page": ["write_report"],
        "reading": ["read_study"],
        "studied": ["Study"],
    },
)
