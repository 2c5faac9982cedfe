"""Print the columns of text tables, from their schemas, when the pages are built."""

import re

from pipistrelle.arrays.layout import ARRAY
from pipistrelle.config import LARGEST
from pipistrelle.detection.logs.recording import MEASUREMENTS
from pipistrelle.detection.logs.vehicle import ODOMETRY
from pipistrelle.experiments.hearing.caller_paths import ROUTE
from pipistrelle.experiments.hearing.world_folder import LANDMARKS as BODIES
from pipistrelle.experiments.runs.truth_files import LANDMARKS, TRUTH
from pipistrelle.text_tables import TEXT_COLUMNS

MARK = re.compile(r"`(.+)` <!-- columns of (.+) -->")
"""The header of a table, which a reader of the raw page sees, and the name of its schema."""
SCHEMAS = {
    **{f"the odometry of a {name}": ODOMETRY[name] for name in ("unicycle", "bicycle")},
    "the odometry of poses": ODOMETRY["poses"],
    "measurements": MEASUREMENTS,
    "the truth": TRUTH,
    "true landmarks": LANDMARKS,
    "a world's landmarks": BODIES,
    "a route": ROUTE,
    "an array": ARRAY,
}


def add_columns(app, docname, content):
    """Replace each mark on a page by the columns of its table."""
    content[0] = MARK.sub(lambda mark: markdown(SCHEMAS[mark[2]]), content[0])


def markdown(schema):
    """Return the columns of a schema as a table."""
    rows = ["| column | unit | meaning | values |", "|---|---|---|---|"]
    for name in (*schema.columns, *schema.optional):
        column, more = TEXT_COLUMNS[name], ", optional" * (name in schema.optional)
        rows.append(f"| `{name}`{more} | {column.unit} | {column.meaning} | {values(column)} |")
    return "\n".join(rows)


def values(column):
    """Return the bounds of a column, empty if any number is valid."""
    if column.whole:
        return "whole numbers"
    if column.high == -column.low == LARGEST:
        return ""
    low = "above 0" if column.low == 1.0 / LARGEST else f"from {column.low:g}"
    return f"{low} to {column.high:g}".replace("-", "\N{MINUS SIGN}")


def setup(app):
    app.connect("source-read", add_columns)
    return {"parallel_read_safe": True}
