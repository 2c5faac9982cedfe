"""What each variable of a study does: measured, compared in the same worlds, put in words.

This asks nothing of a study but that it has worlds. `measures` says what is looked at, `comparing`
what of it differs from value to value, `answer` words it.
"""
