"""Many worlds: a `plan` (as a file: `plan_file`), the `world` that it tries, the `store` it fills.

`study` runs what is not done yet, on one of the `executors`.
"""
