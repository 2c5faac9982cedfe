"""Scores and result folders: `scores` compares an estimate with the truth, `writing` stores it.

`ros` converts tracks and maps to ROS messages, `reading` reads and checks a result folder.
"""
