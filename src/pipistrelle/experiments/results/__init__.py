"""What a trial found, kept: `scores`, and a `folder` that other tools can read.

`writing` fills it, with the texts and tables of `tables`; `stored` takes these up again, `reading`
says how the mission may be done once more.
"""
