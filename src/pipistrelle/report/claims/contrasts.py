"""Contrasts: one number per world, from two cases side by side or from a curve over time."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.comparison import Relation, Statement, pooled_std, pseudovalues
from pipistrelle.report.claims.published import beam_name
from pipistrelle.report.studied import Rule, Study, kept, samples

STATES = 3.0
"""Expected NEES of a consistent filter of the pose (Bradley & Abaid, Sec. V-A)."""
Way = tuple[str, str]
"""Filter and strategy."""


def differences(
    study: Study,
    rule: Rule,
    score: str,
    first: Way,
    second: Way,
    *,
    name: str,
    relation: Relation = "above",
    below: float = math.inf,
    sigma: bool = False,
) -> list[Statement]:
    """State something of one way's score minus another's, at each beamwidth.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`
    score : one of `outcomes.SCORES`, or `outcomes.COMMON`
    first, second : filter and strategy
        Both passive: there is one beamwidth, that of none.
    name : str
        Of the pair, for the reader.
    relation : str
        As `Statement` has it.
    below : [deg]
        Only beamwidths below this.
    sigma : bool
        The margin is the standard deviation over worlds that the two have in common; else 0.

    Returns
    -------
    list of Statement
        Empty where the study lacks one of the two.
    """
    if not {first, second} <= study.outcomes.keys():
        return []
    blind = first[1] == second[1] == "passive"
    statements = []
    for i, width in enumerate(study.beamwidth[:1] if blind else study.beamwidth):
        if width >= below:
            continue
        pair = samples(study, rule, score, [(*first, i), (*second, i)])
        statements.append(
            Statement(
                label=name if blind else f"{name}, {beam_name(width)}",
                sample=pair[0] - pair[1],
                relation=relation,
                margin=pooled_std(*pair) if sigma and len(pair[0]) > 1 else 0.0,
            )
        )
    return statements


def approach(study: Study, rule: Rule, score: str, name: str) -> Float[np.ndarray, " m"] | None:
    r"""How fast fused leaves passive as the beam widens.

    In each world, the distance of the two scores fitted by a line over the octaves of the
    beamwidth:

    .. math:: |s_{fused} - s_{passive}| \approx a + b \log_2(\mathrm{HPBW})

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`
    score : one of `outcomes.SCORES`
    name : str
        The filter.

    Returns
    -------
    (m) or None
        b of each world, in the score's unit per doubling; None where the study lacks one of the
        two or has a single beamwidth.
    """
    fused, passive = (name, "fused"), (name, "passive")
    beams = len(study.beamwidth)
    if not {fused, passive} <= study.outcomes.keys() or beams < 2:
        return None
    cells = [(*fused, i) for i in range(beams)]
    *wide, alone = samples(study, rule, score, [*cells, (*passive, 0)])
    octave = np.log2(study.beamwidth)
    octave = octave - octave.mean()
    return np.abs(np.array(wide).T - alone[:, None]) @ octave / (octave @ octave)


def curves(
    study: Study, rule: Rule, ways: Sequence[Way]
) -> list[Float[np.ndarray, "m b k"]] | None:
    """NEES over time, in the worlds where every case of these ways counts and has a number.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`
    ways : sequence of filter and strategy

    Returns
    -------
    list of (m, b, k), one per way, or None where the study lacks one
    """
    if not set(ways) <= study.outcomes.keys():
        return None
    nees = [study.outcomes[way].nees for way in ways]
    cells = [(*way, i) for way, mine in zip(ways, nees, strict=True) for i in range(mine.shape[1])]
    counts = kept(study, rule, cells)
    for mine in nees:
        counts &= np.all(np.isfinite(mine), axis=(1, 2))
    return [mine[counts] for mine in nees]


def departure(nees: Float[np.ndarray, "m b k"]) -> Float[np.ndarray, " m"]:
    r"""How far ANEES is from that of a consistent filter, averaged over the beamwidths.

    .. math:: T = \frac{1}{K} \sum_k \ln^2(\bar\epsilon_k / 3)

    Parameters
    ----------
    nees : (m, b, k)

    Returns
    -------
    (m)
        Jackknife pseudo-values of T, which is smooth where the jackknife has to be; of a single
        world, T itself.

    Notes
    -----
    Bradley & Abaid, Eq. (24) and Sec. V-B: over-confident above 3, under-confident below.
    """

    def statistic(mean: Float[np.ndarray, "j k"]) -> Float[np.ndarray, " j"]:
        return np.mean(np.square(np.log(mean / STATES)), axis=1)

    beams = range(nees.shape[1])
    if len(nees) < 2:
        return np.mean([statistic(nees[:, i]) for i in beams], axis=0)
    return np.mean([pseudovalues(nees[:, i], statistic) for i in beams], axis=0)


def lap_fit(study: Study) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]] | None:
    r"""Weights that read the rise and the swing off a curve over time.

    Least squares of

    .. math:: \epsilon(\tau) = a + b \tau + c \, (1 - \cos 2\pi\tau) / 2 + d \sin 2\pi\tau

    with tau the time in laps: b is the rise per lap, c the swing, low at the start of each lap
    and high half-way.

    Parameters
    ----------
    study : Study

    Returns
    -------
    (k) for b and (k) for c, or None
        None for a drive of less than two laps.

    Notes
    -----
    Bradley & Abaid, Sec. V-B.
    """
    frames = next(iter(study.outcomes.values())).nees.shape[2]
    tau = frame_time(study, frames) / lap_time(study)
    if frames == 0 or tau[-1] < 2.0:
        return None
    turn = 2.0 * np.pi * tau
    design = np.column_stack([np.ones(frames), tau, (1.0 - np.cos(turn)) / 2.0, np.sin(turn)])
    _, rise, swing, _ = np.linalg.pinv(design)
    return rise, swing


def frame_time(study: Study, frames: int) -> Float[np.ndarray, " k"]:
    """Times of the frames.

    Parameters
    ----------
    study : Study
    frames : int

    Returns
    -------
    (k) [s]
    """
    scenario = study.config.scenario
    return np.arange(1, frames + 1) * (scenario.steps_per_frame * scenario.step)


def lap_time(study: Study) -> float:
    r"""Time of one round of the drive without noise.

    .. math:: 2 \pi B / (V |\sin\gamma|)

    Parameters
    ----------
    study : Study

    Returns
    -------
    [s]
        Infinite for a straight drive.

    Notes
    -----
    Bradley & Abaid, Eq. (5).
    """
    config = study.config
    rate = config.scenario.speed * abs(math.sin(config.scenario.steering)) / config.motion.wheelbase
    return 2.0 * math.pi / rate if rate > 0.0 else math.inf
