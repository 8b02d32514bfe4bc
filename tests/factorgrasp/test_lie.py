from __future__ import annotations

from fractions import Fraction
from math import factorial

import gtsam
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from factorgrasp import lie
from factorgrasp.errors import InputError

ANGLES = np.concatenate(
    [
        [
            0.0,
            1e-300,
            1e-160,
            1e-12,
            1e-9,
            1e-6,
            1e-4,
            1e-2,
            0.1,
            0.4999999,
            0.5,
            0.5000001,
            1.0,
            2.0,
            2.5,
            3.0,
        ],
        np.pi - np.array([1e-3, 1e-6, 1e-9, 1e-12, 0.0]),
    ]
)


@pytest.fixture
def vectors(rng):
    """Rotation vectors at every interesting angle about random axes and the coordinate axes."""
    axes = rng.normal(size=(40, 3))
    axes = np.concatenate([axes, np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return (ANGLES[:, None, None] * axes).reshape(-1, 3)


def relative_error(a, b):
    return np.max(np.abs(a - b)) / max(1.0, np.max(np.abs(b)))


def test_skew_is_the_cross_product_and_vee_its_inverse(rng):
    v, u = rng.normal(size=(2, 5, 4, 3))
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", lie.skew(v), u), np.cross(v, u), atol=1e-15)
    np.testing.assert_array_equal(lie.vee(lie.skew(v)), v)


def test_vee_takes_the_skew_part(rng):
    v = rng.normal(size=3)
    symmetric = rng.normal(size=(3, 3))
    np.testing.assert_allclose(lie.vee(lie.skew(v) + symmetric + symmetric.T), v, atol=1e-15)


def test_exponential_against_pinocchio_and_gtsam(vectors):
    R = lie.so3_exp(vectors)
    for phi, ours in zip(vectors, R, strict=True):
        np.testing.assert_allclose(ours, pin.exp3(phi), atol=5e-15)
        np.testing.assert_allclose(ours, gtsam.Rot3.Expmap(phi).matrix(), atol=5e-15)


def test_exponential_is_orthonormal(vectors):
    R = lie.so3_exp(vectors)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


def test_logarithm_inverts_the_exponential_at_all_angles(vectors):
    angle = np.linalg.norm(vectors, axis=1)
    below_pi = angle < np.pi - 1e-13
    np.testing.assert_allclose(lie.so3_log(lie.so3_exp(vectors[below_pi])), vectors[below_pi], atol=2e-14)
    # At pi the axis may point either way.
    at_pi = ~below_pi
    back = lie.so3_log(lie.so3_exp(vectors[at_pi]))
    wrong = np.minimum(np.abs(back - vectors[at_pi]).max(axis=1), np.abs(back + vectors[at_pi]).max(axis=1))
    assert at_pi.sum() == 46
    assert wrong.max() < 2e-14


def test_logarithm_keeps_relative_precision_of_tiny_rotations(vectors):
    angle = np.linalg.norm(vectors, axis=1)
    tiny = (angle > 0.0) & (angle < 1e-6)
    back = lie.so3_log(lie.so3_exp(vectors[tiny]))
    np.testing.assert_allclose(back, vectors[tiny], rtol=1e-9, atol=0.0)


def test_logarithm_against_pinocchio(rng):
    R = Rotation.random(200, rng=rng).as_matrix()
    for ours, matrix in zip(lie.so3_log(R), R, strict=True):
        np.testing.assert_allclose(ours, pin.log3(matrix), atol=1e-12)


def test_logarithm_at_exactly_pi():
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(lie.so3_log(R)), np.pi * axis, atol=1e-15)


def test_quaternion_exponential_and_logarithm(vectors):
    q = lie.quaternion_exp_wxyz(vectors)
    np.testing.assert_allclose(lie.quaternion_wxyz_to_matrix(q), lie.so3_exp(vectors), atol=5e-15)
    inside = np.linalg.norm(vectors, axis=1) < np.pi - 1e-13
    for sign, scale in ((1.0, 1.0), (-1.0, 1.0), (1.0, 0.5)):
        back = lie.quaternion_log_wxyz(sign * scale * q[inside])
        np.testing.assert_allclose(back, vectors[inside], atol=2e-15)


def central_difference(function, x, h):
    """d function(x) / dx by a five-point formula, columns last."""
    columns = []
    for k in range(x.size):
        e = np.zeros(x.size)
        e[k] = h
        columns.append(
            (8.0 * (function(x + e) - function(x - e)) - (function(x + 2 * e) - function(x - 2 * e)))
            / (12.0 * h)
        )
    return np.stack(columns, axis=-1)


def test_jacobians_against_finite_differences(rng):
    for angle in (0.0, 1e-9, 1e-3, 0.49, 0.51, 1.5, 3.0):
        axis = rng.normal(size=3)
        phi = angle * axis / np.linalg.norm(axis)
        R = lie.so3_exp(phi)
        left = central_difference(lambda p, R=R: lie.so3_log(lie.so3_exp(p) @ R.T), phi, 1e-3)
        right = central_difference(lambda p, R=R: lie.so3_log(R.T @ lie.so3_exp(p)), phi, 1e-3)
        np.testing.assert_allclose(lie.so3_left_jacobian(phi), left, atol=1e-11)
        np.testing.assert_allclose(lie.so3_right_jacobian(phi), right, atol=1e-11)


def test_jacobians_against_pinocchio_and_gtsam(vectors):
    left, right = lie.so3_left_jacobian(vectors), lie.so3_right_jacobian(vectors)
    right_inverse = lie.so3_right_jacobian_inverse(vectors)
    for k, phi in enumerate(vectors):
        np.testing.assert_allclose(right[k], pin.Jexp3(phi), atol=1e-12)
        np.testing.assert_allclose(left[k], pin.Jexp3(-phi), atol=1e-12)
        np.testing.assert_allclose(right[k], gtsam.Rot3.ExpmapDerivative(phi), atol=1e-12)
        if np.linalg.norm(phi) < np.pi - 1e-5:
            np.testing.assert_allclose(right_inverse[k], pin.Jlog3(pin.exp3(phi)), atol=1e-9)


def exact_sine_and_cosine(x):
    """Taylor series in rational numbers: no rounding until the end."""
    x = Fraction(x)
    sine = sum((-1) ** k * x ** (2 * k + 1) / factorial(2 * k + 1) for k in range(15))
    cosine = sum((-1) ** k * x ** (2 * k) / factorial(2 * k) for k in range(15))
    return sine, cosine


@pytest.mark.parametrize("angle", [1e-3, 0.2, 0.4999999, 0.5000001, 0.9])
def test_jacobians_to_the_last_digit_on_either_side_of_the_series(angle):
    theta = Fraction(angle)
    sine, _ = exact_sine_and_cosine(angle)
    half_sine, half_cosine = exact_sine_and_cosine(angle / 2.0)
    # With phi = (x, y, 0) the entry (0, 1) is x y times the coefficient of S^2 and nothing else.
    x, y = 0.6 * angle, 0.8 * angle
    left = (theta - sine) / theta**3
    inverse = (1 - theta / 2 * half_cosine / half_sine) / theta**2
    tolerance = 1e-15 if angle < 0.5 else 2e-14
    ours = lie.so3_left_jacobian([x, y, 0.0])[0, 1] / (x * y)
    assert ours == pytest.approx(float(left), rel=tolerance, abs=0.0)
    ours = lie.so3_left_jacobian_inverse([x, y, 0.0])[0, 1] / (x * y)
    assert ours == pytest.approx(float(inverse), rel=tolerance, abs=0.0)


def test_jacobian_inverses(vectors):
    eye = np.broadcast_to(np.eye(3), (len(vectors), 3, 3))
    np.testing.assert_allclose(
        lie.so3_left_jacobian(vectors) @ lie.so3_left_jacobian_inverse(vectors), eye, atol=1e-13
    )
    np.testing.assert_allclose(
        lie.so3_right_jacobian_inverse(vectors) @ lie.so3_right_jacobian(vectors), eye, atol=1e-13
    )


def test_quaternions_against_scipy_and_gtsam(rng):
    rotations = Rotation.random(300, rng=rng)
    wxyz = np.roll(rotations.as_quat(), 1, axis=1)
    np.testing.assert_allclose(lie.quaternion_wxyz_to_matrix(wxyz), rotations.as_matrix(), atol=1e-15)
    ours = lie.matrix_to_quaternion_wxyz(rotations.as_matrix())
    np.testing.assert_allclose(ours, np.where(wxyz[:, :1] < 0.0, -wxyz, wxyz), atol=1e-15)
    assert (ours[:, 0] >= 0.0).all()
    theirs = gtsam.Rot3.Quaternion(*wxyz[0]).matrix()
    np.testing.assert_allclose(lie.quaternion_wxyz_to_matrix(wxyz[0]), theirs, atol=1e-15)


def test_quaternion_of_any_norm_gives_a_rotation(rng):
    q = rng.normal(size=(20, 4))
    R = lie.quaternion_wxyz_to_matrix(q)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(R, lie.quaternion_wxyz_to_matrix(-3.0 * q), atol=1e-14)


def test_matrix_to_quaternion_at_all_angles(vectors):
    R = lie.so3_exp(vectors)
    np.testing.assert_allclose(lie.quaternion_wxyz_to_matrix(lie.matrix_to_quaternion_wxyz(R)), R, atol=5e-15)


def test_continuous_sequence_crosses_half_turns_and_gaps():
    angle = np.linspace(0.0, 12.0 * np.pi, 500)
    R = lie.so3_exp(angle[:, None] * np.array([0.6, 0.0, 0.8]))
    R[100:110] = np.nan
    q = lie.matrix_to_quaternion_wxyz(R, continuous=True)
    assert np.isnan(q[100:110]).all()
    known = q[np.isfinite(q).all(axis=1)]
    assert len(known) == 490
    assert (np.einsum("ij,ij->i", known[1:], known[:-1]) > 0.0).all()
    expected = np.concatenate(
        [np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * [0.6, 0.0, 0.8]], axis=1
    )
    good = np.isfinite(q).all(axis=1)
    np.testing.assert_allclose(q[good], expected[good], atol=1e-14)


def test_continuity_leaves_the_callers_array_alone():
    q = np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]])
    lie.continuous_quaternions(q)
    assert q[1, 0] == -1.0


def test_quaternion_product_and_conjugate(rng):
    a, b = (np.roll(Rotation.random(50, rng=rng).as_quat(), 1, axis=1) for _ in range(2))
    product = lie.quaternion_wxyz_to_matrix(lie.quaternion_multiply_wxyz(a, b))
    expected = lie.quaternion_wxyz_to_matrix(a) @ lie.quaternion_wxyz_to_matrix(b)
    np.testing.assert_allclose(product, expected, atol=1e-14)
    unit = lie.quaternion_multiply_wxyz(a, lie.quaternion_conjugate(a))
    np.testing.assert_allclose(unit, np.broadcast_to([1.0, 0, 0, 0], unit.shape), atol=1e-15)
    # One quaternion against many.
    np.testing.assert_array_equal(
        lie.quaternion_multiply_wxyz(a[0], b), lie.quaternion_multiply_wxyz(np.tile(a[0], (50, 1)), b)
    )


def test_se3_against_pinocchio_and_gtsam(vectors, rng):
    xi = np.concatenate([rng.normal(size=vectors.shape), vectors], axis=1)
    T = lie.se3_exp(xi)
    for k in range(0, len(xi), 7):
        np.testing.assert_allclose(T[k], pin.exp6(xi[k]).homogeneous, atol=2e-14)
        # gtsam has the angular part first.
        theirs = gtsam.Pose3.Expmap(np.concatenate([xi[k, 3:], xi[k, :3]])).matrix()
        np.testing.assert_allclose(T[k], theirs, atol=1e-12)
    inside = np.linalg.norm(vectors, axis=1) < np.pi - 1e-13
    np.testing.assert_allclose(lie.se3_log(T[inside]), xi[inside], atol=1e-13)


def test_projection_is_the_nearest_rotation(rng):
    M = lie.so3_exp(rng.normal(size=(30, 3))) + 0.2 * rng.normal(size=(30, 3, 3))
    M[0] = np.diag([1.0, 1.0, -1.0])  # a reflection has to become a rotation as well
    R = lie.project_to_so3(M)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-13)
    distance = np.linalg.norm(M - R, axis=(1, 2))
    for _ in range(20):
        other = R @ lie.so3_exp(rng.normal(scale=0.1, size=(30, 3)))
        assert (np.linalg.norm(M - other, axis=(1, 2)) >= distance - 1e-12).all()


def test_angle_between_is_exact_at_both_ends(vectors, rng):
    R = Rotation.random(rng=rng).as_matrix()
    angle = lie.angle_between(R, R @ lie.so3_exp(vectors))
    np.testing.assert_allclose(angle, np.linalg.norm(vectors, axis=1), atol=2e-15)


def test_nan_stays_in_its_row(rng):
    R = lie.so3_exp(rng.normal(size=(5, 3)))
    R[2] = np.nan
    for out in (
        lie.so3_log(R),
        lie.matrix_to_quaternion_wxyz(R),
        lie.project_to_so3(R),
        lie.angle_between(R, R),
    ):
        rows = np.isnan(out).reshape(5, -1)
        assert rows[2].all()
        assert not rows[[0, 1, 3, 4]].any()


def test_leading_axes_and_single_values(rng):
    phi = rng.normal(size=(2, 3, 4, 3))
    for function in (
        lie.so3_exp,
        lie.so3_left_jacobian,
        lie.so3_right_jacobian_inverse,
        lie.quaternion_exp_wxyz,
    ):
        many = function(phi)
        assert many.shape[:3] == (2, 3, 4)
        np.testing.assert_array_equal(function(phi[1, 2, 3]), many[1, 2, 3])
    R = lie.so3_exp(phi)
    for function in (lie.so3_log, lie.matrix_to_quaternion_wxyz, lie.project_to_so3):
        np.testing.assert_allclose(function(R[1, 2, 3]), function(R)[1, 2, 3], atol=1e-15)
    assert lie.so3_log(np.zeros((0, 3, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("call", "found"),
    [
        (lambda: lie.so3_exp(np.zeros((3, 2))), "(3, 2)"),
        (lambda: lie.so3_log(np.zeros(3)), "(3,)"),
        (lambda: lie.se3_exp(np.zeros(3)), "(3,)"),
        (lambda: lie.quaternion_wxyz_to_matrix(np.zeros((4, 3))), "(4, 3)"),
        (lambda: lie.matrix_to_quaternion_wxyz(np.zeros((2, 2, 3, 3)), continuous=True), "(2, 2, 4)"),
    ],
)
def test_wrong_shapes_are_named(call, found):
    with pytest.raises(InputError) as caught:
        call()
    assert found in caught.value.found
