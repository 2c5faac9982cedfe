"""Sound files to logs: what a recording holds, when its vehicle called, what is heard in it.

A recording is a folder: sound files, ``recording.toml`` (`description`), ``array.csv``
(`recorded_array`), ``calls.csv`` and odometry. `hearing` takes it to a log.
"""
