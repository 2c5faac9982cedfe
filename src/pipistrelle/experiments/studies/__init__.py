"""Studies of many worlds: a `plan`, the trials of each `world`, and the `store` of their results.

`study` runs the unfinished worlds in this process or on an executor of `executors`.
"""
