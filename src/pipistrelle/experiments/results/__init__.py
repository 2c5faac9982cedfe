"""The results of a trial: their `scores`, and the `folder` that keeps them for other tools.

`writing` fills it, with the texts and tables of `tables`; `stored` takes these up again, `reading`
says how the mission may be done once more.
"""
