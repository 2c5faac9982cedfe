import numpy as np
import pytest

from pipistrelle.arrays.layout import square_of_four
from pipistrelle.config import Config, ReceiverConfig

LAYOUT = square_of_four(ReceiverConfig())


def test_four_faces_look_to_the_front_left_back_and_right():
    facing = np.column_stack((np.cos(LAYOUT.normal), np.sin(LAYOUT.normal)))
    np.testing.assert_allclose(facing, [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-15)
    assert np.all((LAYOUT.normal >= -np.pi) & (LAYOUT.normal < np.pi))


def test_ten_centred_elements_are_spaced_by_half_the_vehicles_wavelength():
    config = Config()
    half = config.air.sound_speed / config.emitter.frequency / 2.0
    np.testing.assert_allclose(np.diff(LAYOUT.position), [half] * 9, rtol=1e-12)
    assert LAYOUT.position.sum() == pytest.approx(0.0, abs=1e-15)


def test_every_direction_is_within_75_degrees_of_one_or_two_faces():
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    off = np.abs(np.angle(np.exp(1j * (bearing[:, None] - LAYOUT.normal))))
    faces = np.sum(off <= np.radians(75.0), axis=1)
    assert set(faces) == {1, 2}
    assert np.mean(faces == 2) == pytest.approx(60.0 / 90.0, abs=0.01)  # 15 to 75 degrees
