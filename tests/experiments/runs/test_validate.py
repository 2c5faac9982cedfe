"""What a mission is refused for before it is heard, and what a receiver confuses."""

import math
import re

import numpy as np
import pytest

from pipistrelle.arrays.beamforming import beampattern
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.config import (
    AirConfig,
    Config,
    DetectionConfig,
    EmitterConfig,
    InputError,
    ReceiverConfig,
    ScenarioConfig,
    WaterConfig,
)
from pipistrelle.experiments import machine
from pipistrelle.experiments.runs import validate
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.runs.validate import checked_scenario, warnings_of
from pipistrelle.settings import from_flags, resolve


def settings(**values: float) -> Config:
    return resolve(from_flags({section: dict([pair]) for section, pair in values.items()}))


def test_the_papers_receiver_confuses_nothing():
    assert warnings_of(Config()) == ()


@pytest.mark.parametrize("spacing", [0.006, 0.007, 0.0098])
def test_the_lobe_that_is_warned_of_is_where_the_array_has_one(spacing):
    config = Config(receiver=ReceiverConfig(spacing=spacing))
    warning = warnings_of(config)[0]
    angle, lobe = (int(found) for found in re.findall(r"(-?\d+) degrees", warning))
    array = {
        "position": square_of_four(config.receiver).position,
        "frequency": 35e3,
        "speed_of_sound": 343.0,
    }
    angles = np.radians(np.arange(-75.0, 0.0, 0.1))
    alias = beampattern(angles, steered=math.radians(angle + 1), **array)
    assert np.degrees(angles[np.argmax(alias)]) == pytest.approx(lobe, abs=5.0)
    assert alias.max() == pytest.approx(1.0, abs=0.01)
    assert beampattern(angles[angles < -0.6], steered=math.radians(angle - 6), **array).max() < 0.8


def test_a_lobe_outside_the_scanned_angles_counts_at_the_scan_limit():
    receiver, detection = ReceiverConfig(spacing=0.007), DetectionConfig(scan_limit_deg=30.0)
    (warning,) = warnings_of(Config(receiver=receiver, detection=detection))
    assert "echoes 64 degrees off" in warning
    assert "as from -30 degrees" in warning


def test_cold_air_makes_half_a_wave_shorter():
    (warning,) = warnings_of(Config(air=AirConfig(temperature_c=5.0)))
    assert "0.51 of a wave at emitter.frequency (35000 Hz)" in warning


def test_settings_for_air_are_reported_in_water():
    water = ScenarioConfig(medium="water")
    deaf, close = warnings_of(Config(scenario=water))
    assert "in water hides echoes from less than 2.1 m" in deaf  # c T / 2
    assert "rays.range_bounds begin at 0.5 m" in deaf
    assert close.startswith("receiver.spacing: 0.0049 m is 0.12 of a wave in water")
    assert "4.3 times as coarse as of half a wave (0.021 m)" in close
    (idle,) = warnings_of(Config(water=WaterConfig(depth=3.0)))
    assert idle.startswith('water.depth: counts for nothing where scenario.medium is "air"')
    cold = warnings_of(Config(scenario=water, air=AirConfig(temperature_c=5.0)))
    assert [line.split(":")[0] for line in cold[:1]] == ["air.temperature_c"]
    emitter, receiver = EmitterConfig(call_duration=6e-4), ReceiverConfig(spacing=0.0212)
    fits = {"emitter": emitter, "receiver": receiver}
    assert warnings_of(Config(scenario=water, **fits)) == ()


def test_an_undersampled_tone_is_reported_with_its_alias():
    config = Config(emitter=EmitterConfig(frequency=120e3), receiver=ReceiverConfig(spacing=0.0014))
    (warning,) = warnings_of(config)
    assert warning.startswith(
        "receiver.sample_rate: 200000 Hz is less than twice emitter.frequency"
    )
    n = np.arange(40)
    real, alias = np.cos(2 * np.pi * 120e3 * n / 200e3), np.cos(2 * np.pi * 80e3 * n / 200e3)
    np.testing.assert_allclose(real, alias, atol=1e-9)
    assert "would hold it as 80000 Hz" in warning


def test_without_room_for_a_recording_the_setting_that_makes_it_long_is_named(monkeypatch):
    monkeypatch.setattr(machine, "installed", lambda: 50e6)
    checked_scenario(Config())
    for section, pair, key in (
        ("scenario", ("beacon_distance", 15e3), "scenario.beacon_distance"),
        ("scenario", ("radius", 15e3), "scenario.radius"),
        ("scenario", ("start", (15e3, 0.0, 0.0)), "scenario.start"),
        ("emitter", ("call_duration", 60.0), "emitter.call_duration"),
    ):
        with pytest.raises(InputError, match=rf"^{key}: a recording of \d+ s may need .* GB"):
            checked_scenario(settings(**{section: pair}))
        checked_scenario(settings(**{section: pair}), workers=0)


def test_running_a_mission_checks_its_recording(monkeypatch):
    monkeypatch.setattr(validate, "check_recording", lambda *_, **__: pytest.fail("asked"))
    with pytest.raises(pytest.fail.Exception, match="asked"):
        run_mission(Config(), ["fused"])


def test_a_vehicle_faster_than_sound_is_refused_with_the_setting():
    with pytest.raises(InputError, match=r"^scenario\.speed: the vehicle reaches 3[45]\d m/s"):
        checked_scenario(settings(scenario=("speed", -345.0)))
    with pytest.raises(InputError, match=r"^motion\.speed_std: the vehicle reaches"):
        checked_scenario(settings(motion=("speed_std", 300.0)))
    checked_scenario(settings(scenario=("speed", 30.0)))


@pytest.mark.parametrize(
    ("settings", "keys"),
    [
        ({"emitter": {"frequency": 40.0}}, ["emitter.frequency"]),
        ({"beacon": {"band": (28.0, 18.0)}}, ["beacon.band", "beacon.band"]),
        ({"callers": ({"frequency": 30.0},)}, ["callers.1.frequency"]),
        ({"emitter": {"frequency": 1e3}}, []),
    ],
)
def test_any_frequency_below_a_kilohertz_is_asked_about(settings, keys):
    config = Config.model_validate(settings)
    asked = [line for line in warnings_of(config) if "is it in kHz?" in line]
    assert [line.split(":")[0] for line in asked] == keys
