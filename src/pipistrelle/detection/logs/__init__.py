"""Recorded logs: a drive as files, whatever wrote them.

A `recording` is what every format comes to: controls and scans. `text_tables` reads columns of
numbers, `folder` this project's own folders, `mrclam` those of UTIAS MRCLAM; `readers` finds, of
all formats, the one of a folder.
"""
