"""What a trial found, kept: `scores`, and a `folder` that other tools can read.

`writing` fills it, with the texts and tables of `tables`; `reading` takes it up again.
"""
