"""Recorded logs: a drive as files, whatever wrote them.

`folder` reads and writes this project's own folders, `mrclam` reads those of UTIAS MRCLAM, both by
way of `text_tables`; a `recording` is what either comes to.
"""
