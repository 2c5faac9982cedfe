"""Sound files to logs: what a recording holds, when its vehicle called, what is heard in it.

A recording is a folder (`folder`): sound files, ``recording.toml`` (`description`), ``array.csv``
(`array_csv`), ``calls.csv`` and odometry. `hearing` takes it to a log.
"""
