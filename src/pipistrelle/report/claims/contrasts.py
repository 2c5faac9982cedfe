"""Contrasts: one number per world, from two cases side by side or from a curve over time.

`select` lays a study out under an exclusion rule, with the contrast that the whole package is
about: active minus fused.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.comparison import (
    Relation,
    Statement,
    judge,
    pooled_std,
    pseudovalues,
)
from pipistrelle.report.studied import (
    COMMON,
    POSITION,
    POSITION_ALIGNED,
    RULES,
    Rule,
    Selection,
    Study,
    Way,
    case_name,
    filter_titles,
    kept,
    lost_worlds,
    own_cases,
    samples,
)


def selections(study: Study) -> dict[Rule, Selection]:
    """Lay a study out under each exclusion rule.

    Returns: by the names of `studied.RULES`.
    """
    return {rule: select(study, rule) for rule in RULES}


def select(study: Study, rule: Rule) -> Selection:
    """Lay a study out under an exclusion rule: the worlds lost, and the gains of fused sensing."""
    names = filter_titles(study)
    lost = {name: lost_worlds(study, name) for name in names}
    bare = Selection(study=study, rule=rule, lost=lost, gains={})
    gains = {
        (name, score): judge(differences(bare, score, *_gain(name), name=name))
        for name in names
        for score in (POSITION, POSITION_ALIGNED, COMMON)
    }
    return replace(bare, gains=gains)


def differences(
    selection: Selection,
    score: str,
    first: Way,
    second: Way,
    *,
    name: str,
    relation: Relation = "above",
    above: float = 0.0,
    below: float = math.inf,
    sigma: bool = False,
    fitted: Callable[[float], bool] = lambda width: False,
) -> list[Statement]:
    """Make a statement on the difference of two ways' scores for each combination.

    Parameters
    ----------
    selection : Selection
    score : one of `studied.SCORES`, or `studied.COMMON`
    first, second : filter and strategy
        Both passive: the beamwidth makes no further combinations.
    name : str
        Of the pair, for the reader.
    relation : str
        As `Statement` has it.
    above, below : [deg]
        Only beamwidths from the one on and below the other.
    sigma : bool
        The margin is the standard deviation over worlds that the two have in common; else 0.
    fitted : function of a beamwidth [deg]
        Whether the settings were fitted to what is stated there.

    Returns
    -------
    list of Statement
        Empty where the study lacks one of the two.
    """
    study = selection.study
    if not {first, second} <= study.trials.keys():
        return []
    numbers = sorted({*own_cases(study.trials[first]), *own_cases(study.trials[second])})
    named = max((first, second), key=lambda way: len(own_cases(study.trials[way])))
    statements = []
    for i in map(int, numbers):
        width = float(study.beamwidth[i])
        if not above <= width < below:
            continue
        pair = samples(selection, score, [(*first, i), (*second, i)])
        spread = pooled_std(*pair) if len(pair[0]) > 1 else math.nan
        at = case_name(study, named, i)
        statements.append(
            Statement(
                label=f"{name}, {at}" if at else name,
                sample=pair[0] - pair[1],
                relation=relation,
                margin=spread if sigma and len(pair[0]) > 1 else 0.0,
                sigma=spread,
                fitted=bool(fitted(width)),
            )
        )
    return statements


def approach(selection: Selection, score: str, name: str) -> Float[np.ndarray, " m"] | None:
    r"""Return by how much fused departs from passive per doubling of the beamwidth.

    In each world, the distance of the two scores fitted by a line over the octaves of the
    beamwidth:

    .. math:: |s_{fused} - s_{passive}| \approx a + b \log_2(\mathrm{HPBW})

    `name`: the filter. Returns: b of each world, in the score's unit per doubling; None where the
    study lacks one of the two or has a single beamwidth.
    """
    fused, passive = (name, "fused"), (name, "passive")
    study = selection.study
    beams = len(study.beamwidth)
    if not {fused, passive} <= study.trials.keys() or beams < 2:
        return None
    cells = [(*fused, i) for i in range(beams)]
    *wide, alone = samples(selection, score, [*cells, (*passive, 0)])
    octave = np.log2(study.beamwidth)
    octave = octave - octave.mean()
    return np.abs(np.array(wide).T - alone[:, None]) @ octave / (octave @ octave)


def curves(selection: Selection, ways: Sequence[Way]) -> list[Float[np.ndarray, "m b k"]] | None:
    """Return the NEES over time in the worlds where all cases of these ways count."""
    trials = selection.study.trials
    if not set(ways) <= trials.keys():
        return None
    nees = [trials[way].nees for way in ways]
    cells = [(*way, i) for way, one in zip(ways, nees, strict=True) for i in range(one.shape[1])]
    counts = kept(selection, cells)
    for one in nees:
        counts &= np.all(np.isfinite(one), axis=(1, 2))
    return [one[counts] for one in nees]


def departure(
    nees: Float[np.ndarray, "m b k"], expected: Float[np.ndarray, "b k"]
) -> Float[np.ndarray, " m"]:
    """Return how far ANEES is from that of a consistent filter, averaged over the beamwidths.

    `expected`: of a consistent filter. Returns: jackknife pseudo-values of `anees_departure`, which
    is smooth where the jackknife has to be; of a single world, its own.
    """
    found = []
    for i, curve in enumerate(expected):
        statistic = partial(anees_departure, expected=curve)
        alone = len(nees) < 2
        found.append(statistic(nees[:, i]) if alone else pseudovalues(nees[:, i], statistic))
    return np.mean(found, axis=0)


def anees_departure(
    anees: Float[np.ndarray, "*j k"], expected: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "*j"]:
    r"""Return how far ANEES is from that of a consistent filter, over all frames.

    .. math:: T = \frac{1}{K} \sum_k \ln^2(\bar\epsilon_k / E_k)

    `expected`: E, below 3 where the start is exact (`evaluation.bound.nees_of_exact_start`).

    Bradley & Abaid, Eq. (24) and Sec. V-B, who compare with 3: over-confident above,
    under-confident below.

    Examples
    --------
    >>> anees_departure(np.array([[3.0, 2.0], [3.0 * np.e, 2.0 / np.e]]), np.array([3.0, 2.0]))
    array([0., 1.])
    """
    return np.mean(np.square(np.log(anees / expected)), axis=-1)


def lap_fit(study: Study) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]] | None:
    r"""Return the weights that read the rise and the swing off a curve over time.

    Least squares of

    .. math:: \epsilon(\tau) = a + b \tau + c \, (1 - \cos 2\pi\tau) / 2 + d \sin 2\pi\tau

    with tau the time in laps: b is the rise per lap, c the swing, low at the start of each lap
    and high half-way.

    Returns: none for a drive of less than two laps.

    Bradley & Abaid, Sec. V-B.
    """
    frames = next(iter(study.trials.values())).nees.shape[2]
    tau = frame_time(study, frames) / lap_time(study)
    if frames == 0 or tau[-1] < 2.0:
        return None
    turn = 2.0 * np.pi * tau
    design = np.column_stack([np.ones(frames), tau, (1.0 - np.cos(turn)) / 2.0, np.sin(turn)])
    _, rise, swing, _ = np.linalg.pinv(design)
    return rise, swing


def frame_time(study: Study, frames: int, number: int = 0) -> Float[np.ndarray, " k"]:
    """Return the times of the frames.

    `number`: of the combination. Returns [s].
    """
    scenario = study.configs[number].scenario
    return np.arange(1, frames + 1) * (scenario.steps_per_frame * scenario.step)


def lap_time(study: Study, number: int = 0) -> float:
    r"""Return the time of one round of the drive without noise.

    .. math:: 2 \pi B / (V |\sin\gamma|)

    `number`: of the combination. Returns [s]: infinite for a straight drive.

    Bradley & Abaid, Eq. (5).
    """
    config = study.configs[number]
    rate = config.scenario.speed * abs(math.sin(config.scenario.steering)) / config.motion.wheelbase
    return 2.0 * math.pi / rate if rate > 0.0 else math.inf


def _gain(name: str) -> tuple[Way, Way]:
    """Return the two ways whose difference is the gain of fused sensing with a filter."""
    return (name, "active"), (name, "fused")
