"""Scores and result folders: `scores` compares an estimate with the truth, `writing` stores it.

`tables` formats tracks, maps and scans, `ros` converts them to ROS messages, and `reading` reads
and checks a result folder.
"""
