"""Draw the picture of `calls.md` anew, and print its numbers: `.venv/bin/python docs/calls.py`.

`docs/calls.py noise` prints how often noise passes, and `docs/calls.py pairs` what becomes of two
echoes, with `detection.overlaps` off and on.

A tone of 45 kHz, and sweeps from 60 to 35 kHz by both laws, all of 2.8 ms, are heard by one face.
Left: errors of the range of one echo, over the Cramer-Rao bound of the sweep; of a tone the bound
of a sweep is no bound, but its errors stand beside. Right: how often two echoes of equal loudness
are told apart, by their distance.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

PICTURE = Path(__file__).parent / "images" / "calls.png"
SWEEP = {"call": "sweep", "taper": 0.2}
CALLS = {
    "tone": {"frequency": 45e3},
    "linear sweep": SWEEP,
    "hyperbolic sweep": SWEEP | {"sweep": "hyperbolic"},
}
SNR_DB, DRAWS = (8.0, 12.0, 16.0, 20.0, 30.0), 600
APART_MM, PAIRS, PAIR_DB = np.geomspace(4.0, 600.0, 16), 40, 25.0
ANGLE, C = 0.3, 343.0


class Ear:
    """One face that hears a call; `apart` parts echoes."""

    def __init__(self, call, **detection):
        """Settle how the call is recorded, matched and found."""
        from pipistrelle.acoustics.call import band_of
        from pipistrelle.acoustics.paths import callers_of
        from pipistrelle.arrays.layout import Layout, layout_of
        from pipistrelle.arrays.sampling import sampling
        from pipistrelle.config import Config
        from pipistrelle.detection.front_end import front_end
        from pipistrelle.detection.matched import BandFilters

        own = {"emitter": call, "scenario": {"speed": 0.0}, "receiver": {"sample_rate": 200_001}}
        own |= {"detection": detection}
        self.config = Config.model_validate(own)  # a rate that no block has
        settled = sampling(self.config, callers_of(self.config, np.zeros(2))[:1])
        self.settled, self.filters = settled, BandFilters(settled.calls, settled.rate)
        self.face = Layout(normal=np.zeros(1), position=layout_of(self.config).position)
        self.end = front_end(self.config, self.face, settled.tones, calls=settled.calls)
        self.band = band_of(settled.calls[0], settled.rate)

    def delays(self, delay, snr_db, rng):
        """Return the delays found of echoes, and what rows state of their deviation [s]."""
        found = self.found(delay, snr_db, rng)
        strong = found.power > 0.25 * found.power.max(initial=0.0)
        return found.delay[strong], found.delay_std[strong]

    def found(self, delay, snr_db, rng, bearing=ANGLE):
        """Return the detections of echoes."""
        from pipistrelle.acoustics.arrivals import Arrivals
        from pipistrelle.arrays.receiver import record_samples
        from pipistrelle.detection.front_end import find_calls

        delay, settled = np.atleast_1d(delay), self.settled
        echoes = Arrivals(
            delay=delay,
            level_db=np.full(delay.size, snr_db - 10.0 * np.log10(self.band.energy)),
            bearing=np.broadcast_to(bearing, delay.size).astype(float),
            frequency=np.full(delay.size, settled.tones[0]),
            caller=np.zeros(delay.size, dtype=np.int8),
            landmark=1 + np.arange(delay.size),
        )
        blocks = round(14e-3 / settled.interval)
        samples = record_samples(blocks, echoes, self.face, settled).real
        samples = samples + rng.normal(scale=0.5, size=samples.shape)
        channel = np.arange(samples.shape[2])[np.newaxis]
        start, interval = settled.pulse * settled.interval, self.filters.step / settled.rate
        lags = {"start": start, "interval": interval, "pulse": self.filters.pulse}
        matched = self.filters(samples[:, 0], channel)
        return find_calls(matched, self.end, **lags, cut=self.filters.cut)

    def errors_mm(self, snr_db):
        """Return the error of a range, root mean square, what rows state, and the bound [mm]."""
        rng, off, stated = np.random.default_rng(3), [], []
        for _ in range(DRAWS):
            delay = rng.uniform(6e-3, 6.2e-3)
            found, std = self.delays(delay, snr_db, rng)
            if found.size:
                nearest = np.abs(found - delay).argmin()
                off.append(found[nearest] - delay)
                stated.append(std[nearest])
        power = 10.0 ** (snr_db / 10.0) * self.face.position.size
        bound = 1.0 / np.sqrt(2.0 * power) / self.band.spread
        off = np.array(off) - np.median(off)  # half a sample, where edges are sampled
        half = 500.0 * C
        return np.array([np.sqrt(np.mean(off**2)), np.median(stated), bound]) * half

    def apart(self, millimetres):
        """Return how often two echoes so far apart in range are two, each where it is."""
        rng, count, late = np.random.default_rng(5), 0, 2e-3 * millimetres / C
        for _ in range(PAIRS):
            first = rng.uniform(6e-3, 6.2e-3)
            pair = np.array([first, first + late])
            found, _ = self.delays(pair, PAIR_DB, rng)
            count += found.size == 2 and np.abs(np.sort(found) - pair).max() < 0.25 * late
        return count / PAIRS


RATES, ALARMS, SAMPLES = (1e-2, 1e-3, 1e-4), 200, 100_000
"""False-alarm rates; false alarms that are expected; samples of noise at a time."""


def arrays():
    """Return a face of the square, a circle and a cross."""
    from pipistrelle.arrays.layout import Layout, layout_of, scattered
    from pipistrelle.config import Config
    from reference.rooms import ARRAYS

    face = Layout(normal=np.zeros(1), position=layout_of(Config()).position)
    return {"square": face} | {name: scattered(ARRAYS[name]) for name in ("circle", "cross")}


def passed(call, layout, chance):
    """Return how many lags of noise pass, no two of which are alike, and of how many.

    Outputs of a tone are independent draws, as a call's length apart; a sweep's are of samples.
    """
    from pipistrelle.detection.beams import _loudness, wide_of
    from pipistrelle.detection.front_end import Finders, front_end

    ear, microphones = Ear(call, false_alarm=chance), layout.shape[1]
    end = front_end(ear.config, layout, ear.settled.tones, calls=ear.settled.calls)
    cut, tone = ear.filters.cut, "frequency" in call
    step = 200_000 if tone else ear.filters.step  # a second between two draws
    wide = wide_of(ear.config, layout, 0, ear.settled.calls[0], step)
    least = wide.threshold if isinstance(end, Finders) else end.threshold
    rng, count, tests = np.random.default_rng(4), 0, 0
    while tests * chance < ALARMS:
        noise = 0.5 * rng.standard_normal((SAMPLES, 2 * microphones), dtype=np.float32)
        if tone:
            outputs = np.sqrt(2.0) * noise.view(np.complex64).T
            outputs[:, 1::2] = 0.0
        else:
            channel = np.arange(microphones)[np.newaxis]
            outputs = ear.filters(noise, channel)[3 * cut : -3 * cut, 0, 0].T
        outputs = np.ascontiguousarray(outputs)
        if isinstance(end, Finders):
            loudness = _loudness(outputs, wide, least)
        else:
            loudness = np.sum(np.abs(outputs) ** 2, axis=0)
        loudness = loudness[:: 2 if tone else 8]
        count, tests = count + np.count_nonzero(loudness > least), tests + loudness.size
    return count, tests


def noise_rates():
    """Print the share of the asked false alarms that noise causes, with its 95 % interval."""
    from scipy.stats import beta

    print("| array | call | " + " | ".join(f"{rate:g}" for rate in RATES) + " |")
    print("|---|---|" + "--:|" * len(RATES))
    for name, layout in arrays().items():
        for kind in ("tone", "hyperbolic sweep"):
            cells = []
            for rate in RATES:
                count, tests = passed(CALLS[kind], layout, rate)
                low = beta.ppf(0.025, count, tests - count + 1)
                high = beta.ppf(0.975, count + 1, tests - count)
                cells.append(f"{count / tests / rate:.2f} ({low / rate:.2f} to {high / rate:.2f})")
            print(f"| {name} | {kind.split()[-1]} | {' | '.join(cells)} |", flush=True)


DISTANCES_MM, NEAR_MM, NEAR_RAD = (7.5, 15.0, 30.0, 100.0, 300.0, 600.0), 20.0, 0.06
"""Distances of two echoes; how near a row must be to an echo to be right [mm, rad]."""


def rows_of_pairs(ear, millimetres, other):
    """Return rows that are right, echoes missed and false rows, of a pair of echoes on average."""
    rng, right, false = np.random.default_rng(6), 0, 0
    for _ in range(PAIRS):
        delay = rng.uniform(6e-3, 6.2e-3) + np.array([0.0, 2e-3 * millimetres / C])
        found = ear.found(delay, PAIR_DB, rng, bearing=(ANGLE, other))
        late = 500.0 * C * np.abs(found.delay[:, np.newaxis] - delay)
        off = np.abs(found.bearing[:, np.newaxis] - (ANGLE, other))
        fits = (late < NEAR_MM) & (off < NEAR_RAD)
        one = min(fits.any(axis=0).sum(), fits.any(axis=1).sum())
        right, false = right + one, false + len(fits) - one
    return right / PAIRS, 2.0 - right / PAIRS, false / PAIRS


def pairs():
    """Print the rows of two echoes, the first from 17 degrees: right, missed and false."""
    head = " | ".join(f"{far:g} mm" for far in DISTANCES_MM)
    print(f"| bearing of the second | call | `overlaps` | {head} |")
    print("|--:|---|---|" + "--:|" * len(DISTANCES_MM))
    for other in (-0.2, ANGLE):
        for kind in ("tone", "hyperbolic sweep"):
            for overlaps in ("merge", "resolve"):
                ear = Ear(CALLS[kind], overlaps=overlaps)
                rows = [rows_of_pairs(ear, far, other) for far in DISTANCES_MM]
                cells = [", ".join(f"{share:.2f}" for share in row) for row in rows]
                first = f"{np.degrees(other):.0f}° | {kind.split()[-1]} | {overlaps}"
                print(f"| {first} | {' | '.join(cells)} |", flush=True)


def main():
    """Measure, print and draw."""
    from pipistrelle.figures.style import STRATEGY_COLOURS, STYLE

    plt.rcParams.update(STYLE)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained")
    print("| call | " + " | ".join(f"{snr:g} dB" for snr in SNR_DB) + " | two separated from |")
    print("|---|" + "--:|" * (len(SNR_DB) + 1))
    for (name, call), colour in zip(CALLS.items(), STRATEGY_COLOURS.values(), strict=True):
        ear = Ear(call)
        errors = np.array([ear.errors_mm(snr_db) for snr_db in SNR_DB])
        told = np.array([ear.apart(far) for far in APART_MM])
        two = APART_MM[told >= 0.9].min(initial=np.inf)
        cells = [f"{error:.3g} ({error / stated:.2f})" for error, stated, _ in errors]
        print(f"| {name} | {' | '.join(cells)} | {two:.0f} mm |")
        left.semilogy(SNR_DB, errors[:, 0], "o-", color=colour, label=name)
        if name == "linear sweep":  # the other's is 3 % larger: the same line
            left.semilogy(SNR_DB, errors[:, 2], "k:", label="bound of a sweep", zorder=3)
        right.semilogx(APART_MM, told, "o-", color=colour)
    left.set(xlabel="SNR of one microphone, matched [dB]", ylabel="error of a range [mm]")
    right.set(xlabel="distance in range [mm]", ylabel="share of pairs told apart")
    figure.legend(loc="outside upper center", ncols=4)
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    sys.exit({"noise": noise_rates, "pairs": pairs, "": main}["".join(sys.argv[1:])]())
