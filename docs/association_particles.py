"""Print what `association.md` tells of FastSLAM, whose particles' Gaussian associates.

    python docs/association_particles.py [WORLDS]

Worlds of a seed that no study uses, by a thousand particles and the settings `best`, with labels
and by `marginal`.
"""

import sys

from association_tables import error_cell, score_cell

import pipistrelle

SEED, WORLDS = 9100, 16
PLAN = {
    "format": 1,
    "name": "particles",
    "strategies": ["active", "fused", "passive"],
    "filters": ["fastslam"],
    "config": {"settings": "best", "seed": SEED},
    "grid": {"association.method": ["known", "marginal"]},
}


def main(worlds=WORLDS):
    """Print errors over those with labels, as they are and aligned, and what was decided."""
    trials = pipistrelle.study(PLAN, iterations=worlds).trials.sort("iteration")
    for strategy in PLAN["strategies"]:
        known, unlabelled = (
            trials.filter(strategy=strategy, **{"association.method": method})
            for method in PLAN["grid"]["association.method"]
        )
        print(f"{strategy}: {error_cell(known, unlabelled)}; {score_cell(known, unlabelled)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
