"""Every setting, with its unit, its range and the paper's value (Table I) as its default.

Sections are the stages of the chain. Standard deviations end in ``_std`` and are squared once,
where a covariance is built; levels end in ``_db``. A setting that the paper does not report says
so. This module needs pydantic alone, so that the command line can show its help at once.
"""

import math
from itertools import pairwise
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    PlainValidator,
    field_validator,
    model_validator,
)

LARGEST = 1e9
"""No setting needs more of its unit, nor its inverse less: what is squared stays a number."""
FARTHEST = 1e6
"""No range, excess path or step of a vehicle is longer [m], nor any less sure."""
FASTEST = 1e4
"""No vehicle is faster [m/s]."""
WIDEST = 1e4
"""No vehicle steers by more [rad] or turns faster [rad/s], nor is a bearing less sure [rad]."""
STEEPEST = 1.1
"""No car's front wheels steer by more [rad]."""
LONGEST_STEP = 1e5
"""No control step is longer [s]: more than a day."""
LATEST = 3600.0
"""No clock of a sensor is later or earlier than the odometry's by more [s]."""
TONE, SWEEP = "tone", "sweep"
"""Calls that need no file."""
BLOCK = 2e-4
"""Length of a block of samples, over which a receiver sums [s]."""
LEAST_STD = 1e-6
"""No measurement is surer [m] or [rad]: beside the other numbers its variance would be lost."""


def _not_tiny(value: float) -> float:
    """Refuse a number that is above zero in name alone."""
    if value < 1.0 / LARGEST:
        raise ValueError(f"at least {1.0 / LARGEST:g}")
    return value


Real = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
DistanceStd = Annotated[float, Field(ge=LEAST_STD, le=FARTHEST)]
AngleStd = Annotated[float, Field(ge=LEAST_STD, le=WIDEST)]
Count = Annotated[int, Field(ge=1, lt=2**63)]
Level = Annotated[float, Field(ge=-300, le=300)]
Probability = Annotated[float, Field(gt=0, le=1)]


def _gate(value: Any) -> Any:
    """Refuse what is neither a share nor "auto"; a whole number is a share, too."""
    if value == "auto":
        return value
    if isinstance(value, (int, float)) and value is not True and 0.0 < value <= 1.0:
        return float(value)
    raise ValueError('above 0 and up to 1, or "auto"')


Gate = Annotated[
    float | Literal["auto"],
    PlainValidator(_gate, json_schema_input_type=Probability | Literal["auto"]),
]

Strategy = Literal["active", "fused", "passive"]
STRATEGIES: tuple[Strategy, ...] = ("active", "fused", "passive")


class InputError(ValueError):
    """A user's mistake: says where it is, what was found, what was expected and the fix."""

    def _render_traceback_(self) -> list[str]:
        """Show a notebook the line alone, for what it names is the user's and not in our code."""
        return [f"InputError: {self}"]


class Section(BaseModel):
    """A frozen group of settings: unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


MAX_OTHERS = 7
"""Callers besides the vehicle that a recording can tell apart."""


Mark = dict[str, JsonValue]
FOLDER: Mark = {"is": "folder"}
BEAM: Mark = {"is": "beam"}
TABLES: Mark = {"is": "tables"}
ARRAY: Mark = {"is": "array"}
CALL: Mark = {"is": "call"}
"""Marks of settings that are treated in their own way, read by `settings.marked`: a folder, in a
file from where the file lies; what makes the vehicle's beam; a list of tables; and the files of an
array and of a call, from where the file lies, too. ``derived`` names the property that has a
setting's value where it is not given."""


class ScenarioConfig(Section):
    """The true world: a noisy drive, round the paper's circle, among random landmarks."""

    world: Annotated[str, Field(min_length=1)] | None = Field(None, json_schema_extra=FOLDER)
    """Folder of a world of one's own; what it leaves open is drawn as the rest says."""
    medium: Literal["air", "water"] = "air"
    """Medium of the sound; the section of that name describes it."""
    steps: Count = 1500
    """Control steps."""
    step: Annotated[Positive, Field(le=LONGEST_STEP)] = 0.125
    """Length of a control step [s]."""
    steps_per_frame: Count = 4
    """Control steps between two emissions."""
    speed: Annotated[float, Field(ge=-FASTEST, le=FASTEST)] = 0.75
    """Nominal speed [m/s]."""
    steering: Annotated[float, Field(ge=-WIDEST, le=WIDEST)] = 0.027
    """Nominal steering angle [rad]."""
    start: tuple[Real, Real, Real] = (0.0, -7.408, 0.0)
    """True start: x, y [m], heading [rad]; unreported: the noise-free path circles the centre."""
    vehicle: Annotated[int, Field(ge=1, le=1 + MAX_OTHERS)] = 1
    """Whose mission it is: of 2 on, callers with `course = "mission"`, in their order."""
    course: Literal["circle", "eight", "corridor", "lawn-mower"] = "circle"
    """A circle by constant controls, or another shape, for which a driver steers."""
    extent: Positive = 12.0
    """Half the length of a course that is no circle [m]."""
    lane: Positive = 4.0
    """Distance of a lawn-mower's lanes, of an orchard's rows; a corridor's width [m]."""
    field: Literal["disc", "rows", "rooms"] = "disc"
    """Landmarks lie anywhere on a disc, in an orchard's rows, or at corners of rooms."""
    landmarks: Annotated[int, Field(ge=0)] = 50
    """Number of landmarks, without the beacon."""
    radius: Positive = 25.0
    """Largest distance of a landmark from the centre [m]."""
    spacing: NonNegative = 3.0
    """Smallest distance between two landmarks [m]."""
    clearance: NonNegative = 0.5
    """Smallest distance of landmarks and beacon from the path and from each other [m]."""
    beacon_distance: Positive = 15.0
    """Distance of the beacon from the centre [m], and of callers that say nothing else."""


class AirConfig(Section):
    """The medium, unless `scenario.medium` says water. Humidity is unreported in the paper."""

    speed_of_sound: Annotated[float, Field(ge=10, le=10_000)] | None = Field(
        None, json_schema_extra={"derived": "sound_speed"}
    )
    """Speed of sound [m/s]; unless given, that of the temperature T: 343 sqrt(T / 293.15 K)."""
    temperature_c: Annotated[float, Field(gt=-50, lt=60)] = 20.0
    """Temperature [degrees Celsius]."""
    relative_humidity: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Relative humidity [0 to 1]."""
    pressure_kpa: Positive = 101.325
    """Pressure [kPa]."""
    spreading: Literal["paper", "bistatic"] = "paper"
    """Passive echoes lose 20 log10(d1 + d2), the paper's mirror law, or 20 log10(d1 d2) [dB]."""

    @property
    def sound_speed(self) -> float:
        """The speed of sound [m/s]: as it was given, or that of an ideal gas at the temperature."""
        if self.speed_of_sound is not None:
            return self.speed_of_sound
        return 343.0 * math.sqrt((self.temperature_c + 273.15) / 293.15)


class WaterConfig(Section):
    """The medium where `scenario.medium` is water, of the sea or fresh."""

    speed_of_sound: Annotated[float, Field(ge=10, le=10_000)] | None = Field(
        None, json_schema_extra={"derived": "sound_speed"}
    )
    """Speed of sound [m/s]; unless given, that of temperature, salinity and depth."""
    temperature_c: Annotated[float, Field(ge=-2, le=35)] = 10.0
    """Temperature [degrees Celsius]."""
    salinity: Annotated[float, Field(ge=0, le=45)] = 35.0
    """Salinity, in parts per thousand; 0 is fresh water."""
    depth: Annotated[float, Field(ge=0, le=4000)] = 0.0
    """Depth at which vehicle, callers and landmarks are [m]."""
    ph: Annotated[float, Field(ge=5, le=10)] = 8.0
    """Acidity, pH; it counts below some 10 kHz."""
    spreading: Literal["bistatic", "paper"] = "bistatic"
    """Passive echoes lose 20 log10(d1 d2), or 20 log10(d1 + d2), the paper's mirror law [dB]."""

    @property
    def sound_speed(self) -> float:
        """The speed of sound [m/s]: as it was given, or by Coppens (1981).

        A. B. Coppens, Simple equations for the speed of sound in Neptunian waters, J. Acoust. Soc.
        Am. 69 (1981), 862-863: for 0 to 35 degrees, salinities of 0 to 45 and 0 to 4000 m.
        """
        if self.speed_of_sound is not None:
            return self.speed_of_sound
        t, s, d = self.temperature_c / 10.0, self.salinity - 35.0, self.depth / 1000.0
        surface = 1449.05 + t * (45.7 - t * (5.21 - 0.23 * t))
        surface += (1.333 - t * (0.126 - 0.009 * t)) * s
        deeper = (16.23 + 0.253 * t) * d + (0.213 - 0.1 * t) * d**2
        return surface + deeper + (0.016 + 0.0002 * s) * s * t * d


class TargetConfig(Section):
    """What a landmark reflects (radius and shape in practice unreported)."""

    shape: Literal["cylinder", "sphere"] = "cylinder"
    """Short-wave rigid cylinder (the paper's formula, mended) or sphere."""
    radius: Positive = 0.025
    """Radius of a landmark [m]."""


CallName = Annotated[str, Field(min_length=1, max_length=4096)]
Sweep = Literal["linear", "hyperbolic"]
Band = tuple[Positive, Positive]
Share = Annotated[float, Field(ge=0, le=1)]


class CallConfig(Section):
    """The call: a tone, a sweep or a recording."""

    call: CallName = Field(TONE, json_schema_extra=CALL)
    """A `tone`, a `sweep`, or a WAV file of one's own, as long as the call at most."""
    sweep: Sweep = "linear"
    """Law of a sweep: its frequency is linear in time, or, `hyperbolic`, its period is."""
    band: Band = (60e3, 35e3)
    """First and last frequency of a sweep [Hz]."""
    taper: Share = 0.0
    """Share of the call in which it rises and falls as a cosine does: 0 switches it on and off, 1
    is Hann's window, between them Tukey's. A file has what it has."""
    frequency: Positive = 35e3
    """Tone of the call, or where a file's band lies; a sweep has its band [Hz]."""

    @property
    def centre(self) -> float:
        """Where the call's band lies, which beams and absorption go by [Hz]."""
        return 0.5 * (self.band[0] + self.band[1]) if self.call == SWEEP else self.frequency


class EmitterConfig(CallConfig):
    """The vehicle's back-baffled piston and its call."""

    radius: Positive = Field(0.0088, json_schema_extra=BEAM)
    """Radius of the piston [m]; 8.8 mm makes a half-power beamwidth of 33 degrees."""
    level_db: Level = 49.7
    """Source level on the axis at 1 m [dB]; unreported, fitted."""
    off_axis: Literal["pressure", "power"] = "pressure"
    """Off the axis the call loses 20 log10 p, p the piston's pressure, or 10 log10 p [dB]."""
    pulse: Positive = 2.8e-3
    """Length of the call, of the beacon's too [s]; unreported."""


class BeaconConfig(CallConfig):
    """The omnidirectional beacon's call; where callers are listed, what the first leaves open."""

    band: Band = (28e3, 18e3)
    """First and last frequency of a sweep [Hz]."""
    frequency: Positive = 30e3
    """Tone of the call, or where a file's band lies; a sweep has its band [Hz]."""
    level_db: Level = 42.8
    """Source level at 1 m [dB]; unreported, fitted. Of every caller that says no other."""


Point = tuple[Real, Real]
RouteRow = Annotated[tuple[Real, ...], Field(min_length=3, max_length=4)]
_WAYS = {
    "route": ((), "a route"),
    "waypoints": (("speed",), "way-points"),
    "circle": (("speed", "centre", "radius"), 'course = "circle"'),
    "walk": (("place", "distance", "speed_std", "memory"), 'course = "walk"'),
    "mission": ((), 'course = "mission"'),
    "stand": (("place", "distance"), "a caller that stands"),
}
"""What may be said of each way to be somewhere, and how a refusal calls it."""


_CLOCK = ("period", "offset", "jitter", "times")
"""Settings of a caller's own clock."""


class CallerConfig(Section):
    """Someone else who calls, in all directions or as another vehicle: from a place or a way."""

    name: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=40)] | None = None
    """In messages, figures and files; else `beacon` of the first, `caller2` of the second."""
    call: CallName | None = None
    """Its call, as `emitter.call`; else the first calls as the beacon, others send a tone."""
    sweep: Sweep | None = None
    """As `emitter.sweep`; else the beacon's."""
    band: Band | None = None
    """As `emitter.band`, each caller's own; else the beacon's [Hz]."""
    taper: Share | None = None
    """As `emitter.taper`; else the beacon's."""
    frequency: Positive | None = None
    """Tone of the call [Hz], each caller's own; else, of the first, the beacon's."""
    level_db: Level | None = None
    """Source level at 1 m [dB]; else the beacon's, or, of a mission, the vehicle's."""
    place: Point | None = None
    """Where it stands, or a walk begins: x, y [m]."""
    distance: Positive | None = None
    """Else how far from the centre, the direction drawn [m]; else `scenario.beacon_distance`."""
    course: Literal["circle", "walk", "mission"] | None = None
    """It circles, from a place that is drawn, walks at random, or maps the world as the vehicle,
    and calls through a piston like the vehicle's."""
    centre: Point | None = None
    """Of the circle: x, y [m]; else the origin."""
    radius: Positive | None = None
    """Of the circle [m]; else `scenario.beacon_distance`."""
    waypoints: Annotated[tuple[Point, ...], Field(min_length=2)] | None = None
    """Or a line from point to point, x, y [m], and from the last to the first, again and again."""
    speed: Real | None = None
    """Along circle or line [m/s]; below 0 the other way round; else `scenario.speed`."""
    speed_std: Positive | None = None
    """Of a walk: standard deviation of the velocity along each axis [m/s]; else 0.5."""
    memory: Positive | None = None
    """Time after which 1/e of a walk's velocity is left [s]; else 10."""
    route: str | Annotated[tuple[RouteRow, ...], Field(min_length=2)] | None = None
    """Or where it is when: a CSV file of `time,x,y`, or its rows [s, m, m]; else it stands. With a
    fourth column, `heading` [rad], it is another vehicle, which calls through a piston."""
    period: Annotated[float, Field(ge=0.05, le=LARGEST)] | None = None
    """Time from one call to the next [s]; without any of these four it calls when the vehicle does,
    with `offset` or `jitter` alone as often."""
    offset: NonNegative | None = None
    """Time of its first call [s]; else 0."""
    jitter: NonNegative | None = None
    """Standard deviation of each call's time [s], at most a tenth of the period; else 0."""
    times: tuple[NonNegative, ...] | None = None
    """Or the times of all its calls [s]."""

    @property
    def own_clock(self) -> bool:
        """Whether it calls at times of its own, not when the vehicle does."""
        return any(one is not None for one in (self.period, self.offset, self.jitter, self.times))

    @property
    def way(self) -> str:
        """How it is where it is: route, waypoints, circle, walk, mission or stand."""
        if self.route is not None:
            return "route"
        return "waypoints" if self.waypoints is not None else self.course or "stand"

    @model_validator(mode="after")
    def _one_way(self) -> "CallerConfig":
        besides = {"name", "level_db", *CallConfig.model_fields, *_CLOCK}
        given = self.model_dump(exclude_none=True, exclude=besides)
        may, called = _WAYS[self.way]
        for key in given:
            if key not in may and key != ("course" if self.way == self.course else self.way):
                moving = [words for keys, words in _WAYS.values() if key in keys]
                fix = "leave one of them out"
                if self.way == "stand":
                    fix = f"add {' or '.join(moving)}, or leave it out"
                raise ValueError(f"found {key}, which {called} has not; {fix}")
        if self.place is not None and self.distance is not None:
            raise ValueError("found a place and a distance, expected one of them; leave one out")
        if self.speed == 0.0:
            raise ValueError("found speed 0, expected another; give a place to one that stands")
        if isinstance(self.route, tuple):
            _check_rows(self.route)
        if self.times is not None:
            _check_times(self)
        return self


def _check_times(caller: CallerConfig) -> None:
    """Refuse times of calls beside a rule that makes them, and times that do not rise."""
    for key in _CLOCK[:-1]:
        if getattr(caller, key) is not None:
            raise ValueError(f"found times and {key}, expected one of them; leave one out")
    for before, time in pairwise(caller.times or ()):
        if time <= before:
            raise ValueError(f"found time {time:g} after {before:g}, expected times that rise")


def _check_rows(route: tuple[tuple[float, ...], ...]) -> None:
    """Refuse rows of which one is not later than the one before, or only some have a heading."""
    if len({len(row) for row in route}) > 1:
        raise ValueError("found headings in some rows of the route, expected one in all or in none")
    for row, ((before, *_), (time, *_)) in enumerate(pairwise(route), start=2):
        if time <= before:
            raise ValueError(
                f"found time {time:g} after {before:g} in row {row} of the route, expected times "
                "that rise"
            )


def caller_names(callers: tuple[CallerConfig, ...]) -> tuple[str, ...]:
    """Name callers: as the settings do, else by their place in the list.

    Parameters
    ----------
    callers : tuple of CallerConfig

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> caller_names((CallerConfig(), CallerConfig(name="boat"), CallerConfig()))
    ('beacon', 'boat', 'caller3')
    """
    return tuple(
        caller.name or ("beacon" if j == 1 else f"caller{j}")
        for j, caller in enumerate(callers, start=1)
    )


SQUARE = "square"
"""Name of the array that needs no file."""
MicrophoneRow = tuple[float, float, float, float, str]
"""x, y, z [m], gain [dB] and face of a microphone."""


def _array(value: Any) -> Any:
    """Refuse what names no array and holds no microphones."""
    if isinstance(value, str) and value:
        return value
    rows = value if isinstance(value, list | tuple) else ()
    sound = tuple(
        (*map(float, row[:4]), row[4])
        for row in rows
        if isinstance(row, list | tuple)
        and len(row) == 5
        and isinstance(row[4], str)
        and all(type(one) in (int, float) and abs(one) <= LARGEST for one in row[:4])
    )
    if not sound or len(sound) < len(rows):
        raise ValueError(f'"{SQUARE}", a file of microphones, or its rows of x, y, z, gain, face')
    return sound


_ArrayFile = Annotated[str, Field(json_schema_extra={"format": "file"})]
Array = Annotated[
    Any, PlainValidator(_array, json_schema_input_type=Literal["square"] | _ArrayFile)
]


class ReceiverConfig(Section):
    """The microphones, four line arrays in a square or a file's, their sampling and their noise."""

    array: Array = Field(SQUARE, json_schema_extra=ARRAY)
    """The paper's square, or a file of microphones: `channel,x,y`, perhaps `z,face,gain_db`, in the
    vehicle's frame [m], or Acoular's XML; results hold its rows, x, y, z, gain and face of each."""
    elements: Annotated[int, Field(ge=2, le=64)] = 10
    """Microphones of one array of the square."""
    spacing: Positive = 0.0049
    """Distance between two microphones of the square [m]: half a wavelength at 35 kHz."""
    sample_rate: Positive = 200e3
    """Samples of a microphone in a second [Hz]."""
    noise_level_db: Level = 0.0
    """Noise of one complex sample [dB], on the scale of the source levels."""
    engine: Literal["auto", "block", "dense"] = "auto"
    """Sums over 0.2 ms blocks (exact, fast), every sample at the full rate (slow, the reference),
    or blocks where rate, tones and pulse are whole ones and nobody sweeps, else samples."""


class DetectionConfig(Section):
    """From samples to bearings and ranges. All unreported."""

    false_alarm: Annotated[float, Field(ge=1e-100, lt=0.1)] = 1e-6
    """Probability that noise alone passes one test of one tone."""
    snapshots: Literal["maxima", "runs"] = "maxima"
    """A snapshot: the loudest lag within half a call, or a whole run above the threshold."""
    overlaps: Literal["merge", "resolve"] = "merge"
    """Echoes that overlap in a snapshot: the peaks of one scan, or as many sources, up to three, as
    explain it, each with its own deviations and time of arrival."""
    leakage_db: Level = -28.0
    """A tone counts only above this level relative to the other tone's maximum nearby [dB]."""
    peak_db: Annotated[float, Field(ge=-300, le=0)] = -8.0
    """Peaks of a scan count down to this level under the strongest [dB]."""
    scan_limit_deg: Annotated[float, Field(gt=0, lt=90)] = 80.0
    """Largest steering angle [deg]."""
    angle_limit_deg: Annotated[float, Field(gt=0, lt=90)] = 75.0
    """Largest angle off a face's normal that is kept [deg]."""
    averaging: Literal["plain", "weighted"] = "plain"
    """Mean over the faces: plain (the paper's) or by inverse variance at the array's angle."""

    @model_validator(mode="after")
    def _of_one_lag(self) -> "DetectionConfig":
        if self.overlaps == "resolve" and self.snapshots != "maxima":
            raise ValueError(
                f'overlaps "resolve" needs snapshots "maxima", found "{self.snapshots}"'
            )
        return self


class MatchingConfig(Section):
    """When a detection is of an arrival (known labels), or of the same echo as another face's."""

    delay_gate: Positive = 0.25
    """Largest error of the delay, as a share of the pulse."""
    bearing_gate: Positive = 0.1
    """Largest error of the bearing [rad]."""
    margin_db: NonNegative = 6.0
    """Arrivals expected further than this under the threshold cannot be matched [dB]."""


class AssociationConfig(Section):
    """Data association: how the rows of a scan get the labels of landmarks."""

    method: str = "known"
    """The labels that came with the scans, in a simulation an oracle's (the paper's); "nearest",
    the likeliest assignment of a scan's rows; "joint", the most that fit together; "marginal",
    what is sure over all assignments; or module:Class, an association of your own."""
    detection: Probability = 0.8
    """Assumed probability that a landmark which can be heard is heard."""
    clutter: Positive = 0.06
    """Assumed rows of clutter in a scan, per radian and metre."""
    bearing_std: Positive = 0.05
    """Rows whose bearing is measured less surely than this are left out [rad]."""
    way_std: Positive = 0.35
    """The same of ranges and excess paths [m]."""
    max_range: Positive | None = None
    """How far a sensor that tells no levels sees; unless it is known, nothing is missed [m]."""
    field_of_view: Annotated[Positive, Field(le=2.0 * math.pi)] = 2.0 * math.pi
    """Full angle that such a sensor sees, about its heading [rad]."""


class ListeningConfig(Section):
    """What is taken of what was heard."""

    timing: bool = False
    """Of others' echoes also when: how much later than the call that came straight."""


class MotionConfig(Section):
    """How the vehicle moves, the front wheel of a bicycle, and the noise of its controls."""

    model: Literal["bicycle", "unicycle"] = "bicycle"
    """Commanded are speed and steering angle, or speed and angular rate."""
    wheelbase: Positive = 0.2
    """Distance between the axles [m]."""
    speed_std: NonNegative = 0.1
    """Noise of the speed [m/s]."""
    steering_std: NonNegative = 0.03
    """Noise of the steering angle of a bicycle [rad]."""
    angular_rate_std: NonNegative = 0.1
    """Noise of the angular rate of a unicycle [rad/s]."""
    speed_bias: Real = 0.0
    """What is added to every commanded speed, noise apart [m/s]."""
    turn_bias: Real = 0.0
    """The same of the steering angle [rad] or the angular rate [rad/s]."""


class AssumedConfig(Section):
    """What filters and front end believe otherwise than it is; unless given, the truth."""

    wheelbase: Positive | None = None
    """Distance between the axles [m]."""
    speed_std: NonNegative | None = None
    """Noise of the speed [m/s]."""
    steering_std: NonNegative | None = None
    """Noise of the steering angle of a bicycle [rad]."""
    angular_rate_std: NonNegative | None = None
    """Noise of the angular rate of a unicycle [rad/s]."""
    speed_of_sound: Annotated[float, Field(ge=10, le=10_000)] | None = None
    """By which delays become ranges, and phases bearings [m/s]."""


Parameter = Literal[
    "speed_scale",
    "turn_bias",
    "wheelbase",
    "speed_of_sound",
    "sensor_heading",
    "sensor_place",
    "time_offset",
]
"""What the smoother may estimate of the vehicle itself."""
PARAMETERS: tuple[Parameter, ...] = get_args(Parameter)


class FilterConfig(Section):
    """What the filters assume."""

    noise: Literal["constant", "measured"] = "constant"
    """The next three for every row (the paper's), or what the signal or a log tells of each."""
    range_std: DistanceStd = 0.2
    """Noise of a range [m]."""
    bearing_std: AngleStd = 0.15
    """Noise of a bearing [rad]."""
    excess_path_std: DistanceStd = 0.4
    """Noise of an excess path [m]: of a way, twice what the same delay is of a range."""
    caller_speed_std: Positive = 1.0
    """Velocity along an axis of a caller that moves, before anything is known of it [m/s]."""
    caller_walk_std: NonNegative = 0.2
    """How far that velocity strays in a second, and in t seconds by sqrt(t) as much [m/s]."""
    initial_pose_std: tuple[NonNegative, NonNegative, NonNegative] = (0.05, 0.05, 0.0436)
    """How unsure the start is: x, y [m], heading [rad]."""
    first_pose: Literal["exact", "drawn"] = "exact"
    """The start that they are given: the true pose (the paper's), or one drawn with these."""
    gate: Gate = 1.0
    """Measurements outside this share of their predicted distribution are dropped; 1: none; "auto":
    as suits the estimator."""
    robust: Literal["none", "huber"] = "none"
    """Huber's, by EKFs and smoother: what surprises by more than 2 sigma counts less."""
    calibrate: tuple[Parameter, ...] = ()
    """What the vehicle does not know of itself, and the smoother estimates (`prior`)."""
    window: Positive | None = None
    """Of the smoother: a landmark not heard for so long leaves what each scan works on, until it is
    heard again [s]; else none does. For drives that lead on and on."""


class PriorConfig(Section):
    """How unsure is what `filter.calibrate` names: standard deviations about what is assumed."""

    speed_scale_std: Positive = 0.1
    """Of the true speed over the commanded one, or of the true way over that by the odometry."""
    turn_bias_std: Positive = 0.02
    """Of what is added to every steering angle [rad] or angular rate [rad/s]."""
    wheelbase_std: Positive = 0.1
    """Of a bicycle, as a share of what is assumed."""
    speed_of_sound_std: Positive = 10.0
    """[m/s]; ranges and excess paths grow with it."""
    sensor_heading_std: AngleStd = 0.1
    """Of the sensor's zero bearing from the vehicle's heading [rad]."""
    sensor_place_std: DistanceStd = 0.1
    """Of the sensor, ahead and to the left of the vehicle's point, each [m]."""
    time_offset_std: Annotated[Positive, Field(le=10)] = 0.1
    """Of the delay of the sensor's clock behind the odometry's [s]."""


def _check_rising(near: float, far: float) -> None:
    """Refuse bounds that do not rise."""
    if near >= far:
        raise ValueError(f"range_bounds must rise, found [{near}, {far}]")


class RayConfig(Section):
    """Passive landmarks as a ray of Gaussians (Table I; pruning and power unreported)."""

    ratio: Annotated[float, Field(gt=0, lt=1)] = 0.3
    """Standard deviation of a member as a share of its range (alpha)."""
    density: Annotated[float, Field(ge=1.001, le=10)] = 3.0
    """Ratio of two successive ranges (beta); a large one leaves gaps, and reaches too far."""
    range_bounds: tuple[Positive, Positive] = (0.5, 20.0)
    """Nearest and farthest range covered [m]."""
    prune: Annotated[float, Field(ge=0, lt=1)] = 1e-5
    """Members whose aggregated likelihood falls below this over their number are pruned (tau)."""
    power: Positive = 2.0
    """Sharpening of the weights that share a measurement (n)."""
    weights: Literal["instantaneous", "aggregated"] = "instantaneous"
    """Share by this measurement's likelihoods (the paper's text) or by all so far (Sola's code)."""
    likelihood: Literal["normal", "printed"] = "normal"
    """Of a member: the normal density, or 1/sqrt(2 pi S) inside the exponent, as Eq. (19) reads."""
    spacing: Literal["paper", "auto"] = "paper"
    """As above, or, by the EKFs, bearings too precise for such members wait to be crossed."""
    merge: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Neighbours of a ray become one within so many standard deviations of each other; 0: none."""
    ranged: Literal["anew", "heaviest", "reset", "corrected", "bearing", "others", "moved"] = "anew"
    """How a range for a ray is read: it places the landmark anew, or as `estimation.rays` lists."""

    @model_validator(mode="after")
    def _ordered(self) -> "RayConfig":
        _check_rising(*self.range_bounds)
        if self.spacing == "auto" and self.likelihood == "printed":
            raise ValueError(
                'spacing "auto" needs likelihood "normal", found "printed"; '
                'give spacing "paper", too'
            )
        if self.spacing == "auto" and self.ranged not in ("anew", "bearing"):
            raise ValueError(
                f'spacing "auto" needs ranged "anew" or "bearing", found "{self.ranged}"'
            )
        return self


class FastSlamConfig(Section):
    """The second filter: particles instead of one Gaussian (Table I)."""

    particles: Count = 100
    """Number of particles."""
    resample_below: Annotated[float, Field(ge=0, le=1)] = 0.75
    """Resample when fewer effective particles than this share are left."""
    mixture: Literal["federated", "exact"] = "federated"
    """Bearings shared among a ray's members (the paper's) or an exact Gaussian mixture."""
    weights: Literal["marginal", "sampled"] = "marginal"
    """Weigh by the likelihood before the sample, or at it by prior x likelihood / proposal."""
    estimate: Literal["mixture", "heaviest", "separate"] = "separate"
    """Pose and map are the moments of all particles, those of the heaviest particle, or the pose of
    all and the map of the heaviest."""
    resampled_rays: Literal["kept", "restart"] = "kept"
    """Whether rays keep their members' weights at a resampling, or restart with equal ones."""


Topic = Annotated[str, Field(min_length=1)]


class BagConfig(Section):
    """How `slam` reads a ROS bag; nothing else reads these."""

    odometry: Topic | None = None
    """Topic of the odometry; else the only one there is."""
    echoes: tuple[Topic, ...] = ()
    """Topics of the echoes; else all whose type is known."""
    truth: Topic | None = None
    """Topic that tells where the vehicle truly was, for scoring and for the start; else none."""
    motion: Literal["poses", "twist"] = "poses"
    """The ways between odometry's poses, or its velocities as controls."""
    covariances: bool = True
    """Whether the ways are as sure as the twist's covariance says, where it says something."""
    stamps: Literal["header", "received"] = "header"
    """The times of messages: those of their headers, or when they were received."""
    sensor_pose: tuple[Real, Real, Real] | None = None
    """Pose of every sensor on the vehicle: x, y [m], heading [rad]; unless given, the bag's."""
    speed_of_sound: Annotated[float, Field(ge=10, le=10_000)] | None = None
    """Where pings that tell travel times do not say it [m/s]."""
    step: Annotated[NonNegative, Field(le=LONGEST_STEP)] = 0.1
    """Odometry is merged into steps of this length; 0: each message is one [s]."""
    time_offset: Annotated[Real, Field(ge=-LATEST, le=LATEST)] = 0.0
    """How late the times of echoes are, by the odometry's clock [s]."""
    initial_pose_std: tuple[NonNegative, NonNegative, NonNegative] = (0.05, 0.05, 0.0436)
    """How unsure the start is: x, y [m], heading [rad]."""
    forward_std: NonNegative = 0.01
    """Noise of the way of a step forwards, of poses [m]."""
    sideways_std: NonNegative = 0.005
    """The same to the left [m]."""
    turn_std: NonNegative = 0.015
    """The same of its turn [rad]."""
    velocity_std: NonNegative = 0.1
    """Noise of a twist's velocity in a step [m/s]."""
    angular_rate_std: NonNegative = 0.15
    """The same of its angular rate [rad/s]."""
    range_std: DistanceStd = 0.2
    """Noise of a range that does not say its own [m]."""
    bearing_std: AngleStd = 0.06
    """The same of a bearing [rad]."""
    range_bounds: tuple[Positive, Positive] = (0.5, 20.0)
    """Nearest and farthest range of a passive landmark [m]."""

    @model_validator(mode="after")
    def _ordered(self) -> "BagConfig":
        _check_rising(*self.range_bounds)
        return self


class Config(Section):
    """A whole mission. Each section is described in its own class."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 7
    """Seed of every random stream."""
    settings: Annotated[str, Field(min_length=1)] | None = None
    """Name of the settings that these lie over: `paper`, `physics` or `best`."""
    own: dict[str, dict[str, dict[str, Any]]] | None = None
    """What is one estimator's alone, over what all have: a table for each, as `own.iekf`."""
    callers: Annotated[tuple[CallerConfig, ...], Field(max_length=MAX_OTHERS)] | None = Field(
        None, json_schema_extra=TABLES
    )
    """The callers besides the vehicle, a table each; the paper's beacon by default."""
    scenario: ScenarioConfig = ScenarioConfig()
    air: AirConfig = AirConfig()
    water: WaterConfig = WaterConfig()
    target: TargetConfig = TargetConfig()
    emitter: EmitterConfig = EmitterConfig()
    beacon: BeaconConfig = BeaconConfig()
    receiver: ReceiverConfig = ReceiverConfig()
    detection: DetectionConfig = DetectionConfig()
    matching: MatchingConfig = MatchingConfig()
    listening: ListeningConfig = ListeningConfig()
    association: AssociationConfig = AssociationConfig()
    motion: MotionConfig = MotionConfig()
    assumed: AssumedConfig = AssumedConfig()
    filter: FilterConfig = FilterConfig()
    prior: PriorConfig = PriorConfig()
    rays: RayConfig = RayConfig()
    fastslam: FastSlamConfig = FastSlamConfig()
    bag: BagConfig = BagConfig()

    @field_validator("callers", mode="after")
    @classmethod
    def _each_its_own_name(cls, callers: Any) -> Any:
        names: list[str] = ["vehicle"]
        for name in caller_names(callers or ()):
            if name.casefold() in names:
                raise ValueError(f"found the name {name!r} again, expected another; choose one")
            names.append(name.casefold())
        return callers

    @property
    def medium(self) -> AirConfig | WaterConfig:
        """The section of what the sound travels through."""
        return self.water if self.scenario.medium == "water" else self.air

    @property
    def assumed_sound_speed(self) -> float:
        """The speed of sound that the front end counts with [m/s]."""
        assumed = self.assumed.speed_of_sound
        return self.medium.sound_speed if assumed is None else assumed
