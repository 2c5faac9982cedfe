"""Missions: simulated (`trial`), solved from a log (`replay`), or done again (`rerun`).

`truth_files` reads what is known of the truth of a recorded one; `compiling` has the kernels ready.
"""
