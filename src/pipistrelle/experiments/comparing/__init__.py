"""Results side by side: what differs between folders, in scores, paths and settings.

`folders` says which folders may be compared; `missions` compares what `run` and `slam` leave,
`studies` what studies do, world by world; `matching` finds what two folders have in common.
`writing` keeps what was found.
"""
