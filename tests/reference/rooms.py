"""Sound of a point source at microphones in a room, by pyroomacoustics: a second opinion.

Nothing of the package's own propagation is used: spherical waves, images behind the walls, delays
by windowed sincs, real samples.
"""

import numpy as np

from pipistrelle.acoustics.callers import callers_of
from pipistrelle.arrays.array_file import microphones_of
from pipistrelle.arrays.layout import scattered
from pipistrelle.arrays.pattern import spread_towards
from pipistrelle.arrays.sampling import BLOCK, sampling
from pipistrelle.config import Config
from pipistrelle.detection.front_end import find_calls, front_end
from pipistrelle.detection.matched import filter_blocks
from pipistrelle.geometry import wrap

CONFIG = Config()
SETTLED = sampling(CONFIG, callers_of(CONFIG, np.zeros(2)))
TONES, RATE, PULSE = SETTLED.tones, SETTLED.rate, SETTLED.pulse
C = CONFIG.air.sound_speed
ROOM, CENTRE = np.array([9.0, 8.0]), np.array([4.2, 3.9])
"""Size of the room and where the array is in it [m]."""
TURN = np.arange(8) * np.pi / 4
ARM = np.array([-5, -3, -1, 1, 3, 5]) * 0.00175


def free(places):
    """Return microphones that hang free."""
    return scattered(microphones_of([(x, y, 0.0, 0.0, "") for x, y in places]))


def square():
    """Return the paper's square with its faces where they are: 25 mm from the centre."""
    along, rows = (np.arange(10) - 4.5) * 0.0049, []
    for name, normal in (("front", 0.0), ("left", 0.5), ("back", 1.0), ("right", 1.5)):
        ahead = np.array([np.cos(normal * np.pi), np.sin(normal * np.pi)])
        left = np.array([-ahead[1], ahead[0]])
        rows += [(*(0.025 * ahead + a * left), 0.0, 0.0, name) for a in along]
    return scattered(microphones_of(rows))


ARRAYS = {
    "circle": free(0.012 * np.column_stack((np.cos(TURN), np.sin(TURN)))),
    "cross": free([*((a, 0.0) for a in ARM), *((0.0, a) for a in ARM)]),
    "square": square(),
}


def heard(layout, bearing, distance, *, absorption=None, order=0, seconds=8e-3):
    """Return the samples of every microphone of a call from a place, without noise.

    `absorption`: share of the energy that a wall takes; None: there are no walls; `seconds`: how
    long is recorded after the call has come. And where the images of the source behind the walls
    are, the source among them, from the array [m].
    """
    import pyroomacoustics as pra

    time = np.arange(PULSE * SETTLED.block) / RATE
    call = np.cos(2.0 * np.pi * TONES[0] * time)
    if absorption is None:
        room, origin = pra.AnechoicRoom(2, fs=int(RATE)), np.zeros(2)
    else:
        walls = pra.Material(absorption)
        room = pra.ShoeBox(ROOM, fs=int(RATE), materials=walls, max_order=order)
        origin = CENTRE
    toward = np.array([np.cos(bearing), np.sin(bearing)])
    room.add_source(origin + distance * toward, signal=call)
    room.add_microphone_array((origin + layout.position).T)
    assert room.c == C
    room.simulate()
    late = pra.constants.get("frac_delay_length") // 2
    signals = room.mic_array.signals[:, late:]
    blocks = round((1.2 * distance / C + seconds) / BLOCK)
    out = np.zeros((blocks * SETTLED.block, len(layout.position)))
    out[: signals.shape[1]] = signals.T[: len(out)]
    return out, room.sources[0].images.T - origin


def matched_of(samples, noise_std):
    """Return the matched filter's outputs of real samples."""
    count = np.arange(len(samples)) / RATE
    turned = samples[:, None] * np.exp(-2j * np.pi * np.outer(count, TONES))[:, :, None]
    sums = turned.reshape(-1, SETTLED.block, *turned.shape[1:]).sum(axis=1)[:, np.newaxis]
    return filter_blocks(sums, pulse=PULSE, block=SETTLED.block, noise_std=noise_std)


def noise_for(samples, snr_db):
    """Return the noise with which a microphone has some SNR after the matched filter."""
    loudest = np.abs(matched_of(samples, 1.0)[:, 0, 0]).max(axis=0)
    return np.sqrt(np.mean(loudest**2)) / 10.0 ** (snr_db / 20.0)


def found_in(samples, layout, noise_std, rng, end=None):
    """Return what the front end finds in the samples with noise."""
    noisy = samples + noise_std * rng.standard_normal(samples.shape)
    end = end or front_end(CONFIG, layout, TONES)
    matched = matched_of(noisy, noise_std)
    return find_calls(matched, end, start=0.0, interval=BLOCK, pulse=PULSE)


FAR = 40.0
"""At this distance a face 25 mm from the centre hears from nearly the centre's bearing [m]."""


def bounds(layout, members, bearing, snr_db):
    """Return the Cramer-Rao bounds of bearing [rad] and, of block sums, of delay [s]."""
    count = np.count_nonzero(members)
    place, equal = layout.position[members], np.full(count, count**-0.5)
    power = count * 10.0 ** (snr_db / 10.0)
    kappa = (2.0 * np.pi * TONES[0] / C) ** 2 * spread_towards(np.array([bearing]), place, equal)[0]
    return (2.0 * power * kappa) ** -0.5, BLOCK * (PULSE / 4.0 / power) ** 0.5


def errors(name, snr_db, places, draws, *, order=None):
    """Return errors of bearing and delay in units of their bounds, and of what the rows state.

    A face is asked for sources within 60 degrees of its normal: pyroomacoustics knows no baffle.
    `order`: in which the channels are heard.
    """
    layout, rng, rows = ARRAYS[name], np.random.default_rng(int(snr_db)), []
    end = front_end(CONFIG, layout, TONES)
    for _ in range(places):
        bearing, distance = rng.uniform(-np.pi, np.pi), FAR + rng.uniform(0.0, 0.07)
        samples, _ = heard(layout, bearing, distance)
        noise_std = noise_for(samples, snr_db)
        samples = samples if order is None else samples[:, order]
        for _ in range(draws):
            found = found_in(samples, layout, noise_std, rng, end)
            for g in np.flatnonzero(~(np.cos(bearing - layout.normal) < 0.5)):
                across, late = bounds(layout, layout.group == g, bearing, snr_db)
                power = np.where((found.face == g) & (found.caller == 0), found.power, 0.0)
                if power.max() > 0.0:  # the loudest row: noise makes others
                    r = power.argmax()
                    off = wrap(found.bearing[r] - bearing)
                    after = found.delay[r] - distance / C + 0.5 / RATE  # a sample's middle
                    stated = found.bearing_std[r], found.delay_std[r]
                    rows.append((off / across, after / late, off / stated[0], after / stated[1]))
    return np.array(rows).T
