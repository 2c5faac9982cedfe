"""One drive put to the filters: simulated (`trial`) or recorded (`replay`).

`truth_files` reads what is known of the truth of a recorded one; `compiling` has the kernels ready.
"""
