"""The paper's claims: `published` numbers, `contrasts` of cases, `statements`, `verdicts`.

`answer` says in plain words what they come to.
"""
