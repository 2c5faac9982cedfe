"""Recorded logs: a drive as files, whatever wrote them.

Every format is read into a `recording.Log` of controls and scans: `folder` reads this project's log
folders and UTIAS MRCLAM sets, `bag`, `bag_messages` and `bag_log` read ROS bags and messages.
`readers` lists the formats; `vehicle` holds the keys of ``log.toml``, `poses` the motion between
poses.
"""
