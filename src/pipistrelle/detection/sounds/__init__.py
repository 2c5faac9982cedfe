"""Sound files to logs: read a recording, find the vehicle's calls and detect the echoes.

A recording is a folder: sound files (`sound_file`), ``recording.toml`` and ``array.csv``
(`description`), ``calls.csv`` (`calls`) and odometry. `check` looks for common mistakes, and
`hearing` detects the echoes and makes the log.
"""
