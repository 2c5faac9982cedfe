"""The page of all settings, made of `Config` when the pages are built."""

import json
import re

from pydantic import TypeAdapter

from pipistrelle.config import LARGEST, CallerConfig, Config
from pipistrelle.settings import CALLERS, OWN, PREFIX, SETTINGS, from_flags, known_settings

PLACE = "<!-- settings -->"
CALLER = re.compile(".*<!-- callers -->")
ALL_DRAWN = "any number"
WORDS = {"string": "a folder", "file": "a file", "boolean": "`true` or `false`"}
"""Settings that are no numbers; text that is free is the folder of a world, or names topics."""
TABLES = {
    CALLERS: "tables, see [Callers](callers.md)",
    OWN: "tables, see [below](#settings-of-a-single-estimator)",
    SETTINGS: "a name, see [below](#presets)",
}
"""What settings take that are no single value."""
SIGN = re.compile("([≥>≤<]) ")
UNIT = re.compile(r" ?\[((?!0 to 1)[^]]+)\]")


def add_settings(app, docname, content):
    """Put every setting, and every key of a caller, in the place of its mark on a page."""
    if docname in ("settings", "callers"):
        text = CALLER.sub(lambda _: callers(), content[0])
        content[0] = text.replace(PLACE, markdown())


def markdown():
    """Lay out the settings of each section, under its name."""
    parts, above = [], None
    for key in known_settings():
        if key[:-1] != above:
            above = key[:-1]
            parts.append(titled(above))
        parts[-1] += entry(key)
    return "\n".join(parts)


def callers():
    """Lay out what a table of `[[callers]]` may say."""
    parts = []
    for name, field in CallerConfig.model_fields.items():
        text = " ".join(field.description.split())
        takes = "" if name in ("name", "route", "waypoints") else f"; {extent(field)}"
        parts.append(SIGN.sub("\\1\N{NO-BREAK SPACE}", f"`{name}`\n: {text.rstrip('.')}{takes}."))
    return "\n\n".join(parts)


def titled(section):
    """Return the heading of a section, and what it says of itself."""
    if not section:
        return ""
    meaning = type(getattr(Config(), section[0])).__doc__
    return f"## {section[0]}\n\n{' '.join(meaning.split())}\n\n"


def entry(key):
    """Say what a setting means, what it is by default and what it takes; its flag and variable."""
    field = known_settings()[key]
    text = " ".join(field.description.split())
    units = [] if isinstance(field.default, str) else UNIT.findall(text)
    if len(units) == 1:
        text = UNIT.sub("", text)
    unit = f" {units[0]}" if len(units) == 1 else ""
    takes = TABLES[key] if key in TABLES else extent(field)
    if field.default is None:
        takes = f"None by default; {takes}{unit}"
    else:
        takes = f"Default `{told(field.default)}`{unit}; {takes}"
    takes = SIGN.sub("\\1\N{NO-BREAK SPACE}", takes)
    return f"`{key[-1]}`\n: {text} {takes}.\\\n  `{flag(key)}`, `{variable(key)}`\n\n"


def told(value):
    """Write a value as a file of settings has it."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)


def flag(key):
    """Return the flag that gives a setting."""
    value = None
    for name in reversed(key):
        value = {name: value}
    return from_flags(value)[key].where


def variable(key):
    """Return the variable of the environment that gives a setting."""
    return PREFIX + "__".join(key).upper()


def extent(field):
    """Say which values a setting takes; bounds that hold for every number are left to the text."""
    schema = TypeAdapter(field.rebuild_annotation()).json_schema()
    kinds = [kind for kind in schema.get("anyOf", [schema]) if kind.get("type") != "null"]
    return " or ".join(bounds(kind) for kind in kinds)


def bounds(kind):
    """Say what a kind of value is bounded by."""
    whole = "whole, " if kind["type"] == "integer" else ""
    if "const" in kind:
        return f"`{kind['const']}`"
    if "enum" in kind:
        return " or ".join(f"`{choice}`" for choice in kind["enum"])
    if (name := kind.get("format", kind["type"])) in WORDS:
        return WORDS[name]
    if kind.get("items"):
        each = bounds(kind["items"])
        return f"any of {each}" if "enum" in kind["items"] else f"numbers, each {each}"
    if kind["type"] == "array":
        inner = [bounds(part) for part in kind["prefixItems"]]
        return f"{len(inner)} numbers" + ("" if inner[0] == ALL_DRAWN else f", each {inner[0]}")
    if {"minimum", "maximum"} <= kind.keys() and kind["maximum"] < LARGEST:
        return whole + f"{number(kind['minimum'])} to {number(kind['maximum'])}"
    told = [
        f"{sign} {number(kind[name])}"
        for name, sign in (
            ("minimum", "≥"),
            ("exclusiveMinimum", ">"),
            ("maximum", "≤"),
            ("exclusiveMaximum", "<"),
        )
        if name in kind and abs(kind[name]) < LARGEST
    ]
    return whole + (", ".join(told) or ALL_DRAWN)


def number(value):
    """Write a bound, with a minus as the pages have it."""
    text = f"{value:g}"
    return f"−{text[1:]}" if value < 0 else text


def setup(app):
    app.connect("source-read", add_settings)
    return {"parallel_read_safe": True}
