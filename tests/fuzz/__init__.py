"""Odd logs, settings, folders and deaths, by the thousand: what a person must never see is sought.

A try is drawn from the seed, the target and its own number, and nothing else: it can be had again.
`mutations` spoil text, a target (`logs`, `settings`, `studies`, `kills`) makes tries of them,
`running` keeps what goes wrong in a child process, and `judging` says what is a fault.
"""
