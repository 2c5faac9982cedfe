"""The page: one file that plays a mission. Nothing in it asks for anything outside.

Style, script and numbers are inside; the script is written as files of its own and joined here.
Every text goes through the template's escaping, numbers through base64.
"""

import base64
import json
from importlib.resources import files
from typing import Any

import numpy as np
from markupsafe import Markup

from pipistrelle import __version__
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.figures.outlines import PLACED, RAY
from pipistrelle.figures.player.playback import POSE_STDS, Estimate, Playback, Rows
from pipistrelle.figures.style import STRATEGY_COLOURS, page_colours
from pipistrelle.files import upright

SCRIPTS = ("numbers.js", "drawing.js", "map.js", "charts.js", "player.js")
"""In the order in which they are joined."""


def page(playback: Playback) -> str:
    """Write the page that plays a mission.

    Returns: HTML.
    """
    from jinja2 import Environment, StrictUndefined

    here = files("pipistrelle.figures.player")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((here / "page.html").read_text(encoding="utf-8"))
    script = "".join((here / name).read_text(encoding="utf-8") for name in SCRIPTS)
    text = template.render(
        title=playback.title,
        excess_paths=any(len(estimate.excess_paths.landmark) for estimate in playback.estimates),
        facts=playback.facts,
        version=__version__,
        colours=Markup(page_colours()),
        style=Markup((here / "page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        numbers=Markup(_json(_numbers(playback))),
    )
    return upright(text)


def _numbers(playback: Playback) -> dict[str, Any]:
    """Lay out all that the script is to know."""
    landmarks, true = playback.landmarks, playback.true_pose
    return {
        "time": _packed(playback.time),
        "origin": playback.origin.tolist(),
        "limits": playback.limits,
        "trueStart": None if playback.true_start is None else _packed(playback.true_start),
        "truePose": None if true is None else _packed(true),
        "landmarks": None
        if landmarks is None
        else {"label": _packed(landmarks[0]), "place": _packed(landmarks[1])},
        "callers": [
            {
                "label": label,
                "name": upright(name),
                "moves": place.ndim == 2,
                "place": _packed(place),
            }
            for label, name, place in playback.callers
        ],
        "beamwidth": playback.beamwidth,
        "farthest": playback.farthest,
        "scales": {"placed": _scale(PLACED), "ray": _scale(RAY), "pose": POSE_STDS},
        "estimates": [_estimate(estimate) for estimate in playback.estimates],
    }


def _estimate(estimate: Estimate) -> dict[str, Any]:
    """Lay out what the script is to know of an estimate."""
    known = estimate.strategy in STRATEGY_COLOURS
    optional = {}
    if estimate.callers is not None:
        optional["callers"] = _packed(estimate.callers)
    if len(estimate.excess_paths.landmark):
        optional |= {
            "excessPaths": _rows(estimate.excess_paths),
            "resolved": _packed(estimate.resolved),
        }
    return optional | {
        "name": _name(estimate),
        "role": estimate.strategy if known else "ink",
        "calls": estimate.strategy != "passive",
        "outcome": upright(estimate.outcome),
        "start": _packed(estimate.start),
        "pose": _packed(estimate.pose),
        "spread": _packed(estimate.spread),
        "heard": _rows(estimate.heard),
        "mapped": _rows(estimate.mapped),
        "pruned": _rows(estimate.pruned),
        "cloud": None
        if estimate.cloud is None
        else {"particles": estimate.cloud.shape[1], "pose": _packed(estimate.cloud)},
        "revisedAt": _packed(estimate.revised_at),
        "revised": _rows(estimate.revised),
    }


def _name(estimate: Estimate) -> str:
    """Return an estimate's name as a reader knows it."""
    return f"{estimate.strategy} · {title_of(estimate.filter)}"


def _rows(rows: Rows) -> dict[str, Any]:
    """Pack rows."""
    columns = rows.numbers.shape[1]
    packed = {"first": rows.first, "landmark": rows.landmark, "numbers": rows.numbers}
    return {"columns": columns} | {name: _packed(part) for name, part in packed.items()}


@np.errstate(over="ignore", invalid="ignore")
def _packed(numbers: np.ndarray) -> dict[str, str]:
    """Pack numbers as base64 of four bytes each, the least significant first."""
    whole = np.issubdtype(numbers.dtype, np.integer)
    name, kind = ("int32", "<i4") if whole else ("float32", "<f4")
    return {name: base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")}


def _scale(probability: float) -> float:
    """Return how many standard deviations an ellipse reaches that holds a share of a Gaussian."""
    return float(np.sqrt(-2.0 * np.log1p(-probability)))


def _json(value: Any) -> str:
    """Write JSON that may stand in a page: no text in it can end its element."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("&", "\\u0026")
