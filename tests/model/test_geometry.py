import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.geometry import rotate, rotation_matrices, wrap_angle

angles = st.floats(-1e4, 1e4)
lengths = st.floats(-1e4, 1e4)


@given(angles)
def test_wrapped_angles_are_in_range_and_mean_the_same(angle: float) -> None:
    wrapped = float(wrap_angle(np.array(angle)))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


@given(angles)
def test_wrapping_twice_is_wrapping_once(angle: float) -> None:
    once = wrap_angle(np.array(angle))
    assert wrap_angle(once) == pytest.approx(float(once), abs=1e-12)


def test_ends_of_the_range() -> None:
    wrapped = wrap_angle(np.array([np.pi, -np.pi, 3 * np.pi, 0.0]))
    np.testing.assert_allclose(wrapped, [-np.pi, -np.pi, -np.pi, 0])


@given(lengths, lengths, angles)
def test_rotation_keeps_length_and_adds_the_angle(x: float, y: float, angle: float) -> None:
    turned = rotate(np.array([x, y]), np.array(angle))
    assert np.hypot(*turned) == pytest.approx(np.hypot(x, y), rel=1e-9, abs=1e-9)
    expected = complex(x, y) * np.exp(1j * angle)
    np.testing.assert_allclose(turned, [expected.real, expected.imag], rtol=1e-9, atol=1e-7)


@given(lengths, lengths, angles)
def test_rotating_back(x: float, y: float, angle: float) -> None:
    back = rotate(rotate(np.array([x, y]), np.array(angle)), np.array(-angle))
    np.testing.assert_allclose(back, [x, y], rtol=1e-9, atol=1e-7)


@given(lengths, lengths, angles)
def test_matrices_do_what_rotate_does(x: float, y: float, angle: float) -> None:
    vector = np.array([x, y])
    matrix = rotation_matrices(np.array(angle))
    np.testing.assert_allclose(matrix @ vector, rotate(vector, np.array(angle)), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(2), atol=1e-12)


def test_shapes_broadcast() -> None:
    vectors, angle = np.ones((4, 3, 2)), np.linspace(0, 1, 4)
    assert rotate(vectors, angle[:, None]).shape == (4, 3, 2)
    assert rotation_matrices(angle).shape == (4, 2, 2)
    np.testing.assert_allclose(rotate(vectors, angle[:, None])[2, 0], rotate(np.ones(2), angle[2]))
