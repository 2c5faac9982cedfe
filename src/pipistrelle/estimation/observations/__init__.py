"""Kinds of measurements: bearing, range and excess path, a file for each.

A file has the predicted value, its derivatives, and the rule by which the kind initialises a
landmark. `rows` holds a scan's measurements as kernels take them, and the robust losses.
Columns, units and bounds are in `pipistrelle.detection.scans` and `pipistrelle.text_tables`.
"""
