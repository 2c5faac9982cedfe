"""A world and what is heard in it: `scenario` draws it, `listening` hears it.

`oracle` labels what was heard, the one place where the truth does so.
"""
