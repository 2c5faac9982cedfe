"""Reports of studies: a page with the answer, the paper's claims, figures and numbers.

`study` holds a study as arrays, `effects` compares the values of its variables, `sentences` lists
the results that the paper states, `claims` judges them, `charts` and `tables` prepare figures and
tables, and `page` writes them.
"""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    submod_attrs={
        "claims": ["judge_claims", "judge_sentences"],
        "page": ["write_report"],
        "study": ["Study", "read_study", "selections"],
    },
)
