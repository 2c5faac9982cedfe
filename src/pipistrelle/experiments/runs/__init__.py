"""Missions: simulated (`trial`), replayed from a log (`replay`) or run again (`rerun`).

`heard_world` holds the scans of a simulated world, `truth_files` reads the truth of a recorded log,
`validate` checks settings before a mission, and `compiling` compiles the kernels.
"""
