"""A study's figures as data: its `setting`, its `results`, its `timelines`."""
