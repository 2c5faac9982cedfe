"""Every setting, with its unit, its range and the paper's value (Table I) as its default.

Sections are the stages of the chain. Standard deviations end in ``_std`` and are squared once,
where a covariance is built; levels end in ``_db``. "Unreported" marks values that the paper does
not give. This module imports only pydantic, so that the command line shows its help at once.
"""

import math
from itertools import pairwise
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    field_validator,
    model_validator,
)

LARGEST = 1e9
"""Largest value of a setting and of its inverse, so that squares stay finite."""
FARTHEST = 1e6
"""Largest range, excess path or step of a vehicle, and largest standard deviation of one [m]."""
FASTEST = 1e4
"""Largest speed of a vehicle [m/s]."""
WIDEST = 1e4
"""Largest steering angle [rad], turn rate [rad/s] and standard deviation of a bearing [rad]."""
STEEPEST = 1.1
"""Largest steering angle of a car's front wheels [rad]."""
LONGEST_STEP = 1e5
"""Longest control step [s], more than a day."""
LATEST = 3600.0
"""Largest offset between the clocks of sensor and odometry [s]."""
TONE, SWEEP = "tone", "sweep"
"""Calls that need no file."""
BLOCK = 2e-4
"""Length of a block of samples, over which a receiver sums [s]."""
LEAST_STD = 1e-6
"""Least standard deviation of a measurement [m] or [rad]; smaller variances would round to 0."""


def _not_tiny(value: float) -> float:
    """Return a positive number; raise if it is so small that its inverse exceeds `LARGEST`."""
    if value < 1.0 / LARGEST:
        raise ValueError(f"at least {1.0 / LARGEST:g}")
    return value


Real = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
DistanceStd = Annotated[float, Field(ge=LEAST_STD, le=FARTHEST)]
AngleStd = Annotated[float, Field(ge=LEAST_STD, le=WIDEST)]
SoundSpeed = Annotated[float, Field(ge=10, le=10_000)]
Count = Annotated[int, Field(ge=1, lt=2**63)]
Level = Annotated[float, Field(ge=-300, le=300)]
Probability = Annotated[float, Field(gt=0, le=1)]


def _gate(value: Any) -> Any:
    """Return a gate's probability as a float in (0, 1], or "auto"; raise for any other value."""
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
    """Error of the user's input: its place, the found and the expected value, and a fix."""

    def _render_traceback_(self) -> list[str]:
        """Return the error's message without a traceback, for a notebook to show."""
        return [f"InputError: {self}"]


class Section(BaseModel):
    """A frozen group of settings that rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


MAX_OTHERS = 7
"""Most callers besides the vehicle that a recording can distinguish."""


class ScenarioConfig(Section):
    """The true world: random landmarks, and a noisy drive among them, by default on a circle."""

    world: Annotated[str, Field(min_length=1)] | None = None
    """Folder of a world to use; whatever it omits is drawn by the other settings."""
    medium: Literal["air", "water"] = "air"
    """Medium of the sound; its properties are in the section `air` or `water`."""
    steps: Count = 1500
    """Number of control steps of the mission."""
    step: Annotated[Positive, Field(le=LONGEST_STEP)] = 0.125
    """Length of a control step [s]."""
    steps_per_frame: Count = 4
    """Number of control steps between two emissions."""
    speed: Annotated[float, Field(ge=-FASTEST, le=FASTEST)] = 0.75
    """Commanded speed of the vehicle [m/s]."""
    steering: Annotated[float, Field(ge=-WIDEST, le=WIDEST)] = 0.027
    """Commanded steering angle of the vehicle [rad]."""
    start: tuple[Real, Real, Real] = (0.0, -7.408, 0.0)
    """True start pose: x, y [m], heading [rad]; by default (unreported) the path circles the
    centre."""
    vehicle: Annotated[int, Field(ge=1, le=1 + MAX_OTHERS)] = 1
    """Number of the vehicle to run: 1, or from 2 on the callers with `course = "mission"`."""
    course: Literal["circle", "eight", "corridor", "lawn-mower"] = "circle"
    """Course of the vehicle: a circle by constant controls, or a shape that a driver follows."""
    extent: Positive = 12.0
    """Half the length of any course except the circle [m]."""
    lane: Positive = 4.0
    """Distance between lawn-mower lanes or orchard rows, and width of a corridor [m]."""
    field: Literal["disc", "rows", "rooms"] = "disc"
    """Arrangement of the landmarks: anywhere on a disc, in orchard rows, or at corners of rooms."""
    landmarks: Annotated[int, Field(ge=0)] = 50
    """Number of landmarks, without the beacon."""
    radius: Positive = 25.0
    """Largest distance of a landmark from the centre [m]."""
    inner_radius: NonNegative = 0.0
    """Smallest distance of a landmark of the disc from the centre [m]."""
    density: Literal["area", "distance"] = "area"
    """Distribution of the landmarks over the disc: uniform over its area, or uniform in distance
    from the centre and in direction, which is denser at the centre."""
    spacing: NonNegative = 3.0
    """Smallest distance between two landmarks [m]."""
    clearance: NonNegative = 0.5
    """Smallest distance of landmarks and beacon from the trajectory and from each other [m]."""
    beacon_distance: Positive = 15.0
    """Distance of the beacon from the centre, and of callers without a position [m]."""


class AirConfig(Section):
    """Properties of the air, the default medium; the paper does not report its humidity."""

    speed_of_sound: SoundSpeed | None = None
    """Speed of sound [m/s]; by default 343 sqrt(T / 293.15 K) at the temperature T."""
    temperature_c: Annotated[float, Field(gt=-50, lt=60)] = 20.0
    """Temperature of the air [degrees Celsius]."""
    relative_humidity: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Relative humidity of the air [0 to 1]."""
    pressure_kpa: Positive = 101.325
    """Pressure of the air [kPa]."""
    spreading: Literal["paper", "bistatic"] = "paper"
    """Spreading loss of passive echoes in air [dB]: `paper`, 20 log10(d1 + d2), a mirror, or
    `bistatic`, 20 log10(d1 d2)."""

    @property
    def sound_speed(self) -> float:
        """The given speed of sound, or the speed in an ideal gas at the temperature [m/s]."""
        if self.speed_of_sound is not None:
            return self.speed_of_sound
        return 343.0 * math.sqrt((self.temperature_c + 273.15) / 293.15)


class WaterConfig(Section):
    """Properties of sea or fresh water, the medium if `scenario.medium` is `water`."""

    speed_of_sound: SoundSpeed | None = None
    """Speed of sound [m/s]; by default computed from temperature, salinity and depth."""
    temperature_c: Annotated[float, Field(ge=-2, le=35)] = 10.0
    """Temperature of the water [degrees Celsius]."""
    salinity: Annotated[float, Field(ge=0, le=45)] = 35.0
    """Salinity of the water, in parts per thousand; 0 is fresh water."""
    depth: Annotated[float, Field(ge=0, le=4000)] = 0.0
    """Depth of vehicle, callers and landmarks [m]."""
    ph: Annotated[float, Field(ge=5, le=10)] = 8.0
    """Acidity of the water, pH; it affects sound below about 10 kHz."""
    spreading: Literal["bistatic", "paper"] = "bistatic"
    """Spreading loss of passive echoes in water [dB]: `bistatic`, 20 log10(d1 d2), or `paper`, 20
    log10(d1 + d2), a mirror."""

    @property
    def sound_speed(self) -> float:
        """The given speed of sound, or the speed by Coppens (1981) [m/s].

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
    """Shape and radius of the landmarks' bodies, both unreported in the paper."""

    shape: Literal["cylinder", "sphere"] = "cylinder"
    """Shape of a landmark, rigid at short waves: cylinder (the paper's formula, corrected) or
    sphere."""
    radius: Positive = 0.025
    """Radius of a landmark [m]."""


CallName = Annotated[str, Field(min_length=1, max_length=4096)]
Sweep = Literal["linear", "hyperbolic"]
Band = tuple[Positive, Positive]
Share = Annotated[float, Field(ge=0, le=1)]


class CallConfig(Section):
    """A call: a tone, a sweep or a recorded sound."""

    call: CallName = TONE
    """Waveform of the call: `tone`, `sweep`, or a WAV file no longer than the call."""
    sweep: Sweep = "linear"
    """Law of a sweep: `linear`, its frequency is linear in time, or `hyperbolic`, its period is."""
    band: Band = (60e3, 35e3)
    """First and last frequency of a sweep [Hz]."""
    taper: Share = 0.0
    """Share of the call with a cosine rise and fall (Tukey's window; 1: Hann's); 0 switches the
    call on and off abruptly. A WAV file is not tapered."""
    frequency: Positive = 35e3
    """Frequency of a tone, or centre of a WAV file's band; a sweep uses its band instead [Hz]."""

    @property
    def centre(self) -> float:
        """The centre of the call's band, used for beams and absorption [Hz]."""
        return 0.5 * (self.band[0] + self.band[1]) if self.call == SWEEP else self.frequency


class EmitterConfig(CallConfig):
    """The vehicle's back-baffled piston and its call."""

    radius: Positive = 0.0088
    """Radius of the piston [m]; 8.8 mm give a half-power beamwidth of 33 degrees."""
    level_db: Level = 49.7
    """Source level of the vehicle's call on the axis at 1 m [dB]; unreported, fitted."""
    directivity_law: Literal["pressure", "power"] = "pressure"
    """Loss off the axis [dB]: `pressure`, 20 log10 p with the piston's pressure p, or `power`, 10
    log10 p."""
    call_duration: Positive = 2.8e-3
    """Length of the calls of vehicle and callers [s]; unreported."""


class BeaconConfig(CallConfig):
    """The omnidirectional beacon's call, and the defaults of the first of the listed callers."""

    band: Band = (28e3, 18e3)
    """First and last frequency of the beacon's sweep [Hz]."""
    frequency: Positive = 30e3
    """Frequency of a tone, or centre of a WAV file's band; a sweep uses its band instead [Hz]."""
    level_db: Level = 42.8
    """Source level at 1 m of the beacon and of callers without a `level_db` [dB]; unreported,
    fitted."""


Point = tuple[Real, Real]
RouteRow = Annotated[tuple[Real, ...], Field(min_length=3, max_length=4)]
_CLOCK = ("period", "offset", "jitter", "times")
"""Settings of a caller's clock."""
_WAYS = {
    "route": ((), "a route"),
    "waypoints": (("speed",), "way-points"),
    "circle": (("speed", "centre", "radius"), 'course = "circle"'),
    "walk": (("place", "distance", "speed_std", "memory"), 'course = "walk"'),
    "mission": ((), 'course = "mission"'),
    "stand": (("place", "distance"), "a caller that stands"),
}
"""Settings allowed for each kind of motion, and its name in messages."""


class CallerConfig(Section):
    """A caller, fixed or moving, that calls in all directions or through a vehicle's piston."""

    name: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=40)] | None = None
    """Name in messages, figures and files; by default `beacon`, `caller2`, and so on."""
    call: CallName | None = None
    """Waveform of the call, as for `emitter.call`; by default the beacon's for the first caller, a
    tone for others."""
    sweep: Sweep | None = None
    """Law of a sweep, as for `emitter.sweep`; by default the beacon's."""
    band: Band | None = None
    """Band of a sweep, as for `emitter.band`, different for each caller; by default the beacon's
    [Hz]."""
    taper: Share | None = None
    """Taper of the call, as for `emitter.taper`; by default the beacon's."""
    frequency: Positive | None = None
    """Frequency of the tone [Hz], different for each caller; the first has the beacon's by
    default."""
    level_db: Level | None = None
    """Source level at 1 m [dB]; by default the beacon's, or the vehicle's with `course =
    "mission"`."""
    place: Point | None = None
    """Position of a fixed caller, or start of a walk: x, y [m]."""
    distance: Positive | None = None
    """Distance from the centre if the position is drawn [m]; by default
    `scenario.beacon_distance`."""
    course: Literal["circle", "walk", "mission"] | None = None
    """Motion of the caller: a `circle` from a drawn position, a random `walk`, or the `mission` of
    another vehicle, which calls through a piston."""
    centre: Point | None = None
    """Centre of the circle: x, y [m]; by default the origin."""
    radius: Positive | None = None
    """Radius of the circle [m]; by default `scenario.beacon_distance`."""
    waypoints: Annotated[tuple[Point, ...], Field(min_length=2)] | None = None
    """Corners x, y [m] of a closed line that the caller follows repeatedly."""
    speed: Real | None = None
    """Speed along circle or line [m/s]; negative reverses it; by default `scenario.speed`."""
    speed_std: Positive | None = None
    """Standard deviation of a walk's velocity along each axis [m/s]; by default 0.5."""
    memory: Positive | None = None
    """Time in which a walk's velocity decays to 1/e [s]; by default 10."""
    route: str | Annotated[tuple[RouteRow, ...], Field(min_length=2)] | None = None
    """Trajectory of the caller: a CSV file of `time,x,y`, or its rows [s, m, m]. With a fourth
    column, `heading` [rad], the caller is another vehicle, which calls through a piston."""
    period: Annotated[float, Field(ge=0.05, le=LARGEST)] | None = None
    """Time between two calls [s]; by default the vehicle's. Without `period`, `offset`, `jitter`
    and `times` the caller calls at the same times as the vehicle."""
    offset: NonNegative | None = None
    """Time of the first call [s]; by default 0."""
    jitter: NonNegative | None = None
    """Standard deviation of each call's time [s], at most a tenth of the period; by default 0."""
    times: tuple[NonNegative, ...] | None = None
    """Times of all calls [s], in place of a period."""

    @property
    def own_clock(self) -> bool:
        """Whether the caller calls at other times than the vehicle."""
        return any(getattr(self, name) is not None for name in _CLOCK)

    @property
    def way(self) -> str:
        """Kind of the caller's motion, such as `route` or `circle`."""
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
            if len({len(row) for row in self.route}) > 1:
                expected = "one in all or in none"
                raise ValueError(f"found headings in some rows of the route, expected {expected}")
            for row, ((before, *_), (time, *_)) in enumerate(pairwise(self.route), start=2):
                if time <= before:
                    found = f"found time {time:g} after {before:g} in row {row} of the route"
                    raise ValueError(f"{found}, expected times that rise")
        for key in () if self.times is None else _CLOCK[:-1]:
            if getattr(self, key) is not None:
                raise ValueError(f"found times and {key}, expected one of them; leave one out")
        for before, time in pairwise(self.times or ()):
            if time <= before:
                raise ValueError(f"found time {time:g} after {before:g}, expected times that rise")
        return self


def caller_names(callers: tuple[CallerConfig, ...]) -> tuple[str, ...]:
    """Return the callers' names, by default `beacon` for the first, then `caller2` and so on.

    >>> caller_names((CallerConfig(), CallerConfig(name="boat"), CallerConfig()))
    ('beacon', 'boat', 'caller3')
    """
    numbered = enumerate(callers, start=1)
    return tuple(caller.name or ("beacon" if j == 1 else f"caller{j}") for j, caller in numbered)


SQUARE = "square"
"""Name of the array that needs no file."""
MicrophoneRow = tuple[float, float, float, float, str]
"""x, y, z [m], gain [dB] and face of a microphone."""


def _array(value: Any) -> Any:
    """Return the name of an array, or its microphones as rows; raise for any other value."""
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
    """The microphones, their sampling and their noise."""

    array: Array = SQUARE
    """Microphones: the paper's `square` of four line arrays, or a file: CSV `channel,x,y`,
    optionally `z,face,gain_db`, in the vehicle's frame [m], or Acoular's XML. Results hold its
    rows."""
    elements: Annotated[int, Field(ge=2, le=64)] = 10
    """Number of microphones of each array of the square."""
    spacing: Positive = 0.0049
    """Distance between two microphones of the square [m]: half a wavelength at 35 kHz."""
    sample_rate: Positive = 200e3
    """Sampling rate of each microphone [Hz]."""
    noise_level_db: Level = 0.0
    """Noise level of one complex sample, on the scale of the source levels [dB]."""


class DetectionConfig(Section):
    """The detector, from samples to bearings and ranges; the paper reports none of its settings."""

    false_alarm: Annotated[float, Field(ge=1e-100, lt=0.1)] = 1e-6
    """Probability that noise without a call passes one test of one tone."""
    snapshots: Literal["maxima", "runs"] = "maxima"
    """Extent of a snapshot: the loudest lag within half a call (`maxima`), or a whole run of lags
    above the threshold (`runs`)."""
    overlaps: Literal["merge", "resolve"] = "merge"
    """Treatment of echoes that overlap in a snapshot: `merge` takes the peaks of one beam scan,
    `resolve` fits up to three sources, each with a time of arrival and standard deviations."""
    leakage_db: Level = -28.0
    """Least level of a detection relative to the maximum of other tones nearby [dB]."""
    peak_db: Annotated[float, Field(ge=-300, le=0)] = -8.0
    """Least level of a peak of a beam scan relative to the strongest [dB]."""
    scan_limit_deg: Annotated[float, Field(gt=0, lt=90)] = 80.0
    """Largest steering angle of a beam [deg]."""
    angle_limit_deg: Annotated[float, Field(gt=0, lt=90)] = 75.0
    """Largest angle between a detection and its face's normal [deg]."""
    averaging: Literal["plain", "weighted"] = "plain"
    """Mean of a bearing over the faces: `plain` (the paper's) or `weighted` by the inverse variance
    at each face's angle."""

    @model_validator(mode="after")
    def _of_one_lag(self) -> "DetectionConfig":
        if self.overlaps == "resolve" and self.snapshots != "maxima":
            raise ValueError(
                f'overlaps "resolve" needs snapshots "maxima", found "{self.snapshots}"'
            )
        return self


class MatchingConfig(Section):
    """Largest differences in matching detections to true arrivals, and between faces."""

    delay_gate: Positive = 0.25
    """Largest difference of the delays, as a share of the call's length."""
    bearing_gate: Positive = 0.1
    """Largest difference of the bearings [rad]."""
    margin_db: NonNegative = 6.0
    """Largest distance of a matched arrival's expected level below the threshold [dB]."""


class AssociationConfig(Section):
    """Data association: the assignment of measurements to landmarks."""

    method: str = "known"
    """Method of association: "known", the labels of the scans (the paper's); "nearest", the
    likeliest assignment of a scan; "marginal", the pairs that are probable over all assignments; or
    module:Class, an association of your own."""
    detection_rate: Probability = 0.8
    """Assumed probability of detecting a landmark within the sensor's reach."""
    clutter_rate: Positive = 0.06
    """Assumed number of clutter measurements in a scan, per radian and metre."""
    max_angle_std: Positive = 0.05
    """Largest standard deviation of a bearing; less precise measurements are discarded [rad]."""
    max_range_std: Positive = 0.35
    """Largest standard deviation of a range or an excess path; less precise ones are discarded
    [m]."""


class ListeningConfig(Section):
    """Choice of the measured quantities that estimators use."""

    excess_paths: bool = False
    """Use of excess paths: the delay of a caller's echo after its direct call."""


class MotionConfig(Section):
    """The motion of the vehicle, by default a bicycle, and the noise of its controls."""

    model: Literal["bicycle", "unicycle"] = "bicycle"
    """Motion model: `bicycle`, commanded by speed and steering angle, or `unicycle`, by speed and
    angular rate."""
    wheelbase: Positive = 0.2
    """True distance between the axles [m]."""
    speed_std: NonNegative = 0.1
    """Standard deviation of the speed's noise [m/s]."""
    steering_std: NonNegative = 0.03
    """Standard deviation of the noise of a bicycle's steering angle [rad]."""
    angular_rate_std: NonNegative = 0.1
    """Standard deviation of the noise of a unicycle's angular rate [rad/s]."""
    speed_bias: Real = 0.0
    """Constant error added to every commanded speed [m/s]."""
    turn_bias: Real = 0.0
    """Constant error added to every steering angle [rad] or angular rate [rad/s]."""


class AssumedConfig(Section):
    """Values that estimators and detector assume; by default the true values."""

    wheelbase: Positive | None = None
    """Assumed distance between the axles [m]."""
    speed_std: NonNegative | None = None
    """Assumed standard deviation of the speed's noise [m/s]."""
    steering_std: NonNegative | None = None
    """Assumed standard deviation of the noise of a bicycle's steering angle [rad]."""
    angular_rate_std: NonNegative | None = None
    """Assumed standard deviation of the noise of a unicycle's angular rate [rad/s]."""
    speed_of_sound: SoundSpeed | None = None
    """Assumed speed of sound, which converts delays to ranges and phases to bearings [m/s]."""


Parameter = Literal[
    "speed_scale",
    "turn_bias",
    "wheelbase",
    "speed_of_sound",
    "sensor_heading",
    "sensor_place",
    "time_offset",
    "range_scale",
    "range_bias",
]
"""Calibration parameters that the smoother can estimate."""
PARAMETERS: tuple[Parameter, ...] = get_args(Parameter)


class FilterConfig(Section):
    """Measurement noise, outliers and start pose that the estimators assume."""

    noise: Literal["constant", "measured"] = "constant"
    """Source of measurement noise: `constant` uses range_std, bearing_std and excess_path_std for
    every measurement (the paper's); `measured` uses the standard deviation estimated for each."""
    range_std: DistanceStd = 0.2
    """Standard deviation of a range [m]."""
    bearing_std: AngleStd = 0.15
    """Standard deviation of a bearing [rad]."""
    excess_path_std: DistanceStd = 0.4
    """Standard deviation of an excess path [m], by default twice a range's, because paths are not
    halved."""
    caller_speed_std: Positive = 1.0
    """Standard deviation of a moving caller's initial velocity along each axis [m/s]."""
    caller_walk_std: NonNegative = 0.2
    """Standard deviation of the change of a moving caller's velocity in a second [m/s]; it grows
    with the square root of time."""
    initial_pose_std: tuple[NonNegative, NonNegative, NonNegative] = (0.05, 0.05, 0.0436)
    """Standard deviations of the start pose: x, y [m], heading [rad]."""
    first_pose: Literal["exact", "drawn"] = "exact"
    """Start pose of the estimators: `exact`, the true one (the paper's), or `drawn`, with the
    standard deviations initial_pose_std."""
    gate: Gate = 1.0
    """Share of the predicted distribution outside of which measurements are discarded; 1: none;
    "auto": the share that suits the estimator."""
    robust: Literal["none", "huber", "cauchy"] = "none"
    """Robust loss of EKFs and smoother: `huber` reduces the weight of innovations beyond 2 sigma,
    `cauchy` of all, and of large ones further."""
    calibrate: tuple[Parameter, ...] = ()
    """Calibration parameters that the smoother estimates, from the standard deviations in
    `prior`."""
    window: Positive | None = None
    """Time without measurements after which the smoother leaves a landmark out of its updates,
    until its next measurement [s]; by default never. It bounds the cost of long missions."""


class PriorConfig(Section):
    """Standard deviations of the calibration parameters around their assumed values."""

    speed_scale_std: Positive = 0.1
    """Standard deviation of the ratio of true to commanded speed or of true to measured
    distance."""
    turn_bias_std: Positive = 0.02
    """Standard deviation of the constant error of steering angles [rad] or angular rates
    [rad/s]."""
    wheelbase_std: Positive = 0.1
    """Standard deviation of a bicycle's wheelbase, as a share of the assumed one."""
    speed_of_sound_std: Positive = 10.0
    """Standard deviation of the speed of sound [m/s]; it scales ranges and excess paths."""
    sensor_heading_std: AngleStd = 0.1
    """Standard deviation of the angle between the sensor's zero bearing and the heading [rad]."""
    sensor_place_std: DistanceStd = 0.1
    """Standard deviation of the sensor's position on the vehicle, forward and to the left [m]."""
    time_offset_std: Annotated[Positive, Field(le=10)] = 0.1
    """Standard deviation of the delay of the sensor's clock behind the odometry's [s]."""
    range_scale_std: Positive = 0.1
    """Standard deviation of the ratio of measured to true ranges."""
    range_bias_std: DistanceStd = 1.0
    """Standard deviation of the constant error of measured ranges [m]."""


def _check_rising(near: float, far: float) -> None:
    """Raise if the lower bound of a range is not below the upper bound."""
    if near >= far:
        raise ValueError(f"range_bounds must rise, found [{near}, {far}]")


class RayConfig(Section):
    """Bearing-only landmarks, each a ray of Gaussians (Table I; pruning and power unreported)."""

    relative_std: Annotated[float, Field(gt=0, lt=1)] = 0.3
    """Standard deviation of a ray's member along the ray, as a share of its range (alpha)."""
    range_ratio: Annotated[float, Field(ge=1.001, le=10)] = 3.0
    """Ratio of the ranges of two successive members of a ray (beta); large ratios leave gaps."""
    range_bounds: tuple[Positive, Positive] = (0.5, 20.0)
    """Nearest and farthest range of a ray's members [m]."""
    prune_threshold: Annotated[float, Field(ge=0, lt=1)] = 1e-5
    """Threshold of pruning (tau): a ray's member is removed if its aggregated likelihood is below
    tau over the number of members."""
    exponent: Positive = 2.0
    """Exponent of the weights by which a ray's members share a bearing (n)."""
    weights: Literal["instantaneous", "aggregated"] = "instantaneous"
    """Weights by which a ray's members share a bearing: `instantaneous`, its likelihoods (the
    paper's text), or `aggregated`, of all bearings so far (Sola's code)."""
    likelihood: Literal["normal", "printed"] = "normal"
    """Likelihood of a bearing for a ray's member: `normal`, the density, or `printed`, with
    1/sqrt(2 pi S) inside the exponent, as Eq. (19) reads."""
    precise_bearings: Literal["paper", "auto"] = "paper"
    """Rays of precise bearings: `paper`, members by relative_std and range_ratio, or `auto`,
    delayed initialization of bearings too precise for such members (EKFs only)."""
    merge: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Distance in standard deviations below which neighbours of a ray are merged; 0: never."""
    range_update: Literal["anew", "bearing", "moved"] = "anew"
    """Update of a ray by a range: `anew` initialises the landmark at range and bearing, `bearing`
    ignores the range, `moved` moves the heaviest member to it."""

    @model_validator(mode="after")
    def _ordered(self) -> "RayConfig":
        _check_rising(*self.range_bounds)
        needs = 'precise_bearings "auto" needs'
        if self.precise_bearings == "auto" and self.likelihood == "printed":
            found = 'likelihood "normal", found "printed"; give precise_bearings "paper", too'
            raise ValueError(f"{needs} {found}")
        if self.precise_bearings == "auto" and self.range_update not in ("anew", "bearing"):
            found = f'range_update "anew" or "bearing", found "{self.range_update}"'
            raise ValueError(f"{needs} {found}")
        return self


class FastSlamConfig(Section):
    """FastSLAM 2.0, the paper's second filter: particles instead of one Gaussian (Table I)."""

    particles: Count = 100
    """Number of particles."""
    resample_below: Annotated[float, Field(ge=0, le=1)] = 0.75
    """Share of effective particles below which particles are resampled."""
    mixture: Literal["federated", "exact"] = "federated"
    """Update of a ray by a bearing: `federated` shares it among the members (the paper's), `exact`
    updates the Gaussian mixture."""
    weights: Literal["marginal", "sampled"] = "marginal"
    """Weight of a particle: `marginal`, the likelihood before sampling, or `sampled`, prior x
    likelihood / proposal at the sample."""
    weighed_by: Literal["all", "initialised"] = "all"
    """Landmarks whose measurements weigh particles: `all`, or the fully `initialised` alone."""
    estimate: Literal["mixture", "heaviest", "separate"] = "separate"
    """Estimate of pose and map: `mixture`, the moments of all particles, `heaviest`, the heaviest
    particle, or `separate`, the pose of all and the map of the heaviest."""
    resampled_rays: Literal["kept", "restart"] = "kept"
    """Weights of a ray's members after resampling: `kept`, or `restart` with equal weights."""


Topic = Annotated[str, Field(min_length=1)]


class BagConfig(Section):
    """Reading of a ROS bag by `slam`; no other command uses these settings."""

    odometry: Topic | None = None
    """Topic of the odometry; by default the only one in the bag."""
    echoes: tuple[Topic, ...] = ()
    """Topics of the echoes; by default all of known types."""
    truth: Topic | None = None
    """Topic of the true trajectory, for scores and for the start; by default none."""
    motion: Literal["poses", "twist"] = "poses"
    """Source of the motion: `poses`, differences of the odometry's poses, or `twist`, its
    velocities as controls."""
    covariances: bool = True
    """Use of the twist's covariance for the motion between poses, if it is given."""
    stamps: Literal["header", "received"] = "header"
    """Times of messages: `header`, from their headers, or `received`, the times of reception."""
    sensor_pose: tuple[Real, Real, Real] | None = None
    """Pose of every sensor on the vehicle: x, y [m], heading [rad]; by default the bag's."""
    speed_of_sound: SoundSpeed | None = None
    """Speed of sound for pings with travel times that do not contain it [m/s]."""
    step: Annotated[NonNegative, Field(le=LONGEST_STEP)] = 0.1
    """Length of the steps into which odometry is merged; 0: each message is a step [s]."""
    time_offset: Annotated[Real, Field(ge=-LATEST, le=LATEST)] = 0.0
    """Delay of the echoes' clock behind the odometry's [s]."""
    initial_pose_std: tuple[NonNegative, NonNegative, NonNegative] = (0.05, 0.05, 0.0436)
    """Standard deviations of the start pose: x, y [m], heading [rad]."""
    forward_std: NonNegative = 0.01
    """Standard deviation of a step's forward distance, with poses [m]."""
    sideways_std: NonNegative = 0.005
    """Standard deviation of a step's distance to the left, with poses [m]."""
    turn_std: NonNegative = 0.015
    """Standard deviation of a step's turn, with poses [rad]."""
    velocity_std: NonNegative = 0.1
    """Standard deviation of a step's velocity, with a twist [m/s]."""
    angular_rate_std: NonNegative = 0.15
    """Standard deviation of a step's angular rate, with a twist [rad/s]."""
    range_std: DistanceStd = 0.2
    """Standard deviation of a range whose message gives none [m]."""
    bearing_std: AngleStd = 0.06
    """Standard deviation of a bearing whose message gives none [rad]."""
    range_bounds: tuple[Positive, Positive] = (0.5, 20.0)
    """Nearest and farthest range of a passive landmark in a bag [m]."""

    @model_validator(mode="after")
    def _ordered(self) -> "BagConfig":
        _check_rising(*self.range_bounds)
        return self


class Config(Section):
    """All settings of a mission, in sections."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 7
    """Seed of all random streams."""
    settings: Annotated[str, Field(min_length=1)] | None = None
    """Preset that the other settings override: `paper`, `physics` or `best`."""
    own: dict[str, dict[str, dict[str, Any]]] | None = None
    """Settings for only one estimator, e.g. `own.iekf`; they override the common ones."""
    callers: Annotated[tuple[CallerConfig, ...], Field(max_length=MAX_OTHERS)] | None = None
    """Callers besides the vehicle, a table each; by default the paper's beacon."""
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
        """Settings of the chosen medium, air or water."""
        return self.water if self.scenario.medium == "water" else self.air

    @property
    def assumed_sound_speed(self) -> float:
        """The speed of sound that the detector assumes [m/s]."""
        assumed = self.assumed.speed_of_sound
        return self.medium.sound_speed if assumed is None else assumed
