"""Recordings of a point source at microphones in a room, by pyroomacoustics, as a second opinion.

They use no sound propagation of the package: spherical waves, image sources behind the walls,
windowed-sinc delays, real samples. The package only reads the recordings, as folders of files.
"""

import numpy as np

import pipistrelle
from pipistrelle.arrays.beamforming import spread_towards
from pipistrelle.arrays.layout import array_text, microphones_of, scattered
from pipistrelle.detection.noise import BEARING_FLOOR, RANGE_FLOOR
from pipistrelle.geometry import wrap
from reference.sounds import write_beside

RATE, TONE, SWEEP, LENGTH, C = 200_000, 35e3, (60e3, 35e3), 2.8e-3, 343.0
"""Sample rate; frequency of a tone, of a sweep's ends [Hz]; duration [s]; speed of sound [m/s]."""
ROOM, CENTRE = np.array([9.0, 8.0]), np.array([4.2, 3.9])
"""Size of the room, and position of the array in it [m]."""
TURN = np.arange(8) * np.pi / 4
ARM = np.array([-5, -3, -1, 1, 3, 5]) * 0.00175
ANGLE_LIMIT = np.radians(75.0)
"""Largest angle from its normal at which a face is used: `detection.angle_limit_deg`."""


def free(places):
    """Return microphones without faces."""
    return microphones_of([(x, y, 0.0, 0.0, "") for x, y in places])


def square():
    """Return the paper's square with its faces at their true distance of 25 mm from the centre."""
    along, rows = (np.arange(10) - 4.5) * 0.0049, []
    for name, normal in (("front", 0.0), ("left", 0.5), ("back", 1.0), ("right", 1.5)):
        ahead = np.array([np.cos(normal * np.pi), np.sin(normal * np.pi)])
        left = np.array([-ahead[1], ahead[0]])
        rows += [(*(0.025 * ahead + a * left), 0.0, 0.0, name) for a in along]
    return microphones_of(rows)


ARRAYS = {
    "circle": free(0.012 * np.column_stack((np.cos(TURN), np.sin(TURN)))),
    "cross": free([*((a, 0.0) for a in ARM), *((0.0, a) for a in ARM)]),
    "square": square(),
}


def waveform(call, time):
    """Return a tone, or a sweep that fades in and out, at times since its start [s]."""
    if call == "tone":
        return np.cos(2.0 * np.pi * TONE * time)
    low, high = min(SWEEP), max(SWEEP)
    edge = np.clip(np.minimum(time, LENGTH - time) / (0.1 * LENGTH), 0.0, 1.0)
    turns = high * time - 0.5 * (high - low) * time**2 / LENGTH
    return np.sin(0.5 * np.pi * edge) ** 2 * np.cos(2.0 * np.pi * turns)


def heard(layout, bearing, distance, *, call="tone", absorption=None, order=0, seconds=0.0):
    """Return each microphone's noise-free samples of a call from a given position.

    Faces receive nothing from behind. `absorption` is the share of the energy that a wall absorbs;
    None means no walls. `seconds` are recorded after the arrival of the call. Also returns the
    positions of the source and its images, relative to the array [m].
    """
    import pyroomacoustics as pra

    sent = waveform(call, np.arange(round(LENGTH * RATE)) / RATE)
    if absorption is None:
        room, origin = pra.AnechoicRoom(2, fs=RATE), np.zeros(2)
    else:
        walls = pra.Material(absorption)
        room = pra.ShoeBox(ROOM, fs=RATE, materials=walls, max_order=order)
        origin = CENTRE
    toward = np.array([np.cos(bearing), np.sin(bearing)])
    room.add_source(origin + distance * toward, signal=sent)
    room.add_microphone_array((origin + layout.position).T)
    assert room.c == C
    room.simulate()
    late = pra.constants.get("frac_delay_length") // 2
    signals = room.mic_array.signals[:, late:]
    out = np.zeros((round((1.2 * distance / C + seconds) * RATE), len(layout.position)))
    out[: signals.shape[1]] = signals.T[: len(out)]
    out[:, np.cos(bearing - layout.normal[layout.group]) < 0.0] = 0.0
    return out, room.sources[0].images.T - origin


def noise_for(samples, snr_db):
    """Return the noise that gives a microphone an SNR [dB] after the matched filter."""
    energy = (samples**2).sum(axis=0)
    return np.sqrt(0.5 * energy[energy > 0.0].mean()) / 10.0 ** (snr_db / 20.0)


def record(folder, name, sounds, noise_std, rng, call="tone"):
    """Write a recording of an array, with a call of the vehicle at the start of each sound."""
    import soundfile

    folder.mkdir(exist_ok=True)
    begin, calls, microphones = 0, [], ARRAYS[name]
    form = {"samplerate": RATE, "channels": len(microphones.channel), "subtype": "FLOAT"}
    with soundfile.SoundFile(folder / "tape.wav", "w", **form) as tape:
        for samples in sounds:
            tape.write(samples + noise_std * rng.standard_normal(samples.shape))
            calls.append(begin)
            begin += len(samples)
    write_beside(folder, TONE, LENGTH, C, array_text(microphones), calls, until=11 + begin // RATE)
    if call == "sweep":
        about = folder / "recording.toml"
        key = f'call = "sweep"\nband = {list(SWEEP)}\ntaper = 0.2'
        about.write_text(about.read_text().replace(f"frequency = {TONE}", key))
    return folder


def rows_of(folder, calls):
    """Process a recording; return the measurements, and the index of the call before each."""
    rows = pipistrelle.hear(folder).measurements
    assert rows["caller"].is_null().all() or (rows["caller"] == "").all()
    time = np.sort(np.unique(rows["time"]))
    assert time.size == calls, "after each call something was heard"
    return rows, np.searchsorted(time, rows["time"])


FAR, CUT = 40.0, 0.1
"""Distance at which a face 25 mm from the centre has nearly the centre's bearing [m]; delay of the
vehicle's call after the source's [s]."""


def bounds(layout, bearing, snr_db, call="tone"):
    """Return the Cramer-Rao bounds of bearing [rad] and, for a tone's block sums, of delay [s].

    They hold for a measurement, the mean over the faces that receive it.
    """
    across, late, faces = 0.0, 0.0, 0
    spectrum = np.abs(np.fft.rfft(waveform(call, np.arange(round(LENGTH * RATE)) / RATE), RATE))
    share, frequency = spectrum**2 / np.sum(spectrum**2), np.arange(spectrum.size)
    centre = share @ frequency
    width = np.sqrt(share @ (frequency - centre) ** 2)  # of a tone it is of its edges: none
    wave = TONE if call == "tone" else np.hypot(centre, width)
    for g in range(layout.normal.size):
        if np.cos(bearing - layout.normal[g]) < np.cos(ANGLE_LIMIT):
            continue
        place = layout.position[layout.group == g]
        power = len(place) * 10.0 ** (snr_db / 10.0)
        spread = spread_towards(np.array([bearing]), place, np.full(len(place), len(place) ** -0.5))
        across += 0.5 / (power * (2.0 * np.pi * wave / C) ** 2 * spread[0])
        exact = 0.5 / (2.0 * np.pi * width) ** 2
        late += (0.25 * LENGTH * 2e-4 if call == "tone" else exact) / power
        faces += 1
    return np.sqrt(across) / faces, np.sqrt(late) / faces


def anywhere(layout, rng):
    """Draw a bearing that is clearly inside or outside the angle limit of every face."""
    while True:
        bearing = rng.uniform(-np.pi, np.pi)
        angle = np.abs(wrap(bearing - layout.normal))
        if not (np.abs(angle - ANGLE_LIMIT) < np.radians(7.0)).any():
            return bearing


def errors(folder, name, snr_db, places, draws, *, call="tone", order=slice(None)):
    """Record and process a distant source; return errors of bearing and delay, a row each.

    The first two are in units of their bounds, the others of the measured standard deviations
    without their floors. `order` selects the channels.
    """
    layout, rng, truth = scattered(ARRAYS[name]), np.random.default_rng(int(snr_db)), []

    def sounds():
        for bearing, distance in truth:
            samples, _ = heard(layout, bearing, distance, call=call)
            for _ in range(draws):
                yield samples[round(CUT * RATE) :, order]

    truth = [(anywhere(layout, rng), FAR + rng.uniform(0.0, 0.07)) for _ in range(places)]
    noise_std = noise_for(heard(layout, *truth[0], call=call)[0], snr_db)
    tape = record(folder, name, sounds(), noise_std, rng, call)
    rows, frame = rows_of(tape, places * draws)
    loudest = np.lexsort((-rows["level_db"].to_numpy(), frame))  # others are noise
    rows = rows[loudest[np.unique(frame[loudest], return_index=True)[1]]]
    bearing, distance = np.repeat(truth, draws, axis=0).T
    least = np.array([bounds(layout, one, snr_db, call) for one in bearing]).T
    off = wrap(rows["bearing"].to_numpy() - bearing)
    half = 0.5 / RATE if call == "tone" else 0.0  # the centre of a sample
    late = 2.0 * rows["range"].to_numpy() / C + half
    after = late + CUT - distance / C
    off_std = np.sqrt(rows["bearing_std"].to_numpy() ** 2 - BEARING_FLOOR[0] ** 2)
    after_std = np.sqrt(rows["range_std"].to_numpy() ** 2 - RANGE_FLOOR**2) * 2.0 / C
    return np.array([off / least[0], after / least[1], off / off_std, after / after_std])
