"""The global optimum over SO(3) against closed forms, exhaustive sampling and other people's optimisers."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from factorgrasp import rotation_relaxation as rr
from factorgrasp.errors import InputError
from factorgrasp.lie import angle_between, skew, so3_exp

needs_clarabel = pytest.mark.skipif(
    importlib.util.find_spec("clarabel") is None, reason="clarabel is not installed"
)
ICOSAHEDRAL = Rotation.create_group("I").as_matrix()


def random_symmetric(rng: np.random.Generator) -> np.ndarray:
    Q = rng.normal(size=(10, 10))
    return Q + Q.T


def vector_pairs(a: np.ndarray, b: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Cost ``sum (R a_k - b_k)' W (R a_k - b_k)`` as a matrix Q, written from its definition."""
    Q = np.zeros((10, 10))
    for one, other in zip(a, b, strict=True):
        rows = np.column_stack([np.kron(one[None], np.eye(3)), -other])
        Q += rows.T @ information @ rows
    return Q


def optima(Q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local optima reached from 60 starts and their costs, best first."""
    found = np.array([rr.refine_rotation(Q, start) for start in ICOSAHEDRAL])
    cost = rr.rotation_cost(Q, found)
    order = np.argsort(cost)
    return found[order], cost[order]


def scale_of(Q: np.ndarray) -> float:
    """Spread of the cost over SO(3)."""
    return float(np.std(rr.rotation_cost(Q, ICOSAHEDRAL)))


# ---- the constraints --------------------------------------------------------------------------------------


def test_constraints_vanish_on_rotations_alone():
    forms = rr.constraint_matrices()
    assert forms.shape == (21, 10, 10)
    assert np.linalg.matrix_rank(forms.reshape(21, 100)) == 20
    rotations = Rotation.random(50, random_state=1).as_matrix()
    x = rr.vectorized(rotations)
    np.testing.assert_allclose(np.einsum("ni,kij,nj->nk", x, forms, x), 0.0, atol=1e-14)
    mirrored = rr.vectorized(-rotations)
    assert np.all(np.abs(np.einsum("ni,kij,nj->nk", mirrored, forms, mirrored)).max(axis=1) > 0.1)
    stretched = rr.vectorized(1.1 * rotations)
    assert np.all(np.abs(np.einsum("ni,kij,nj->nk", stretched, forms, stretched)).max(axis=1) > 0.1)


def test_columns_are_stacked():
    R = so3_exp([0.3, -0.2, 0.9])
    np.testing.assert_array_equal(rr.vectorized(R), [*R[:, 0], *R[:, 1], *R[:, 2], 1.0])


def test_newton_step_uses_the_true_gradient():
    rng = np.random.default_rng(3)
    Q = random_symmetric(rng)
    R = rr.refine_rotation(Q, so3_exp(rng.normal(size=3)))
    step = 1e-4 * np.vstack([np.eye(3), -np.eye(3)])
    around = rr.rotation_cost(Q, R @ so3_exp(step))
    here = rr.rotation_cost(Q, R)
    np.testing.assert_allclose((around[:3] - around[3:]) / 2e-4, 0.0, atol=1e-6)
    assert np.all(around > here)


# ---- closed form: Wahba's problem -------------------------------------------------------------------------


def test_wahba_has_its_closed_form():
    rng = np.random.default_rng(5)
    for _ in range(10):
        truth = so3_exp(2.0 * rng.normal(size=3))
        a = rng.normal(size=(20, 3))
        b = a @ truth.T + 0.4 * rng.normal(size=(20, 3))
        peer, _ = Rotation.align_vectors(b, a)
        Q = vector_pairs(a, b, np.eye(3))
        certificate = rr.certify_rotation(Q, peer.as_matrix())
        assert certificate.certified
        assert certificate.smallest_eigenvalue > 0.0
        residual = b - a @ peer.as_matrix().T
        assert certificate.lower_bound == pytest.approx(np.sum(residual**2), rel=1e-7)
        refined = rr.refine_rotation(Q, so3_exp([0.1, 0.2, 0.3]))
        assert angle_between(refined, peer.as_matrix()) < 1e-7


# ---- random instances -------------------------------------------------------------------------------------


@needs_clarabel
def test_random_instances_are_tight_and_local_search_alone_is_trapped():
    rng = np.random.default_rng(11)
    sampled = Rotation.random(4000, random_state=2).as_matrix()
    trapped = local_optima = 0
    for _ in range(200):
        Q = random_symmetric(rng)
        scale = scale_of(Q)
        R, gap, tight = rr.solve_rotation_sdp(Q)
        best = float(rr.rotation_cost(Q, R))
        assert tight
        assert gap <= 1e-7 * scale
        assert best <= rr.rotation_cost(Q, sampled).min()
        certificate = rr.certify_rotation(Q, R)
        assert certificate.certified
        assert certificate.lower_bound == pytest.approx(best, abs=1e-6 * scale)
        # From anywhere: what costs more must not be certified, and every bound must hold.
        for start in ICOSAHEDRAL[::12]:
            local = rr.refine_rotation(Q, start)
            cost = float(rr.rotation_cost(Q, local))
            assert cost >= best - 1e-9 * scale
            other = rr.certify_rotation(Q, local)
            assert other.lower_bound <= best + 1e-9 * scale
            if cost > best + 1e-6 * scale:
                local_optima += 1
                assert not other.certified
            else:
                assert other.certified
        trapped += rr.rotation_cost(Q, rr.refine_rotation(Q, np.eye(3))) > best + 1e-6 * scale
    assert trapped > 20
    assert local_optima > 100


@needs_clarabel
def test_agrees_with_a_general_optimiser_on_quaternions():
    rng = np.random.default_rng(4)

    def cost(q: np.ndarray, Q: np.ndarray) -> float:
        return float(rr.rotation_cost(Q, Rotation.from_quat(q).as_matrix()))

    for _ in range(3):
        Q = random_symmetric(rng)
        peers = [minimize(cost, rng.normal(size=4), args=(Q,), options={"gtol": 1e-9}).fun for _ in range(15)]
        found = rr.rotation_cost(Q, rr.solve_rotation_sdp(Q).rotation)
        assert found == pytest.approx(min(peers), abs=1e-6)


def test_bound_holds_at_any_rotation():
    rng = np.random.default_rng(6)
    for _ in range(20):
        Q = random_symmetric(rng)
        _, costs = optima(Q)
        away = so3_exp(rng.normal(size=3))
        certificate = rr.certify_rotation(Q, away)
        assert not certificate.certified
        assert certificate.lower_bound <= costs[0]
        assert certificate.gap == pytest.approx(rr.rotation_cost(Q, away) - certificate.lower_bound)


# ---- scale, degeneracy ------------------------------------------------------------------------------------


def test_decision_depends_on_neither_scale_nor_offset():
    rng = np.random.default_rng(8)
    forms = rr.constraint_matrices()
    for _ in range(10):
        Q = random_symmetric(rng)
        found, costs = optima(Q)
        worse = found[costs > costs[0] + 1e-3]
        # Constant on SO(3), and much larger than what varies there.
        offset = np.tensordot(1e4 * rng.normal(size=21), forms, 1)
        offset[9, 9] += 3e4
        for other in (1e8 * Q, 1e-8 * Q, Q + offset):
            assert rr.certify_rotation(other, found[0]).certified
            if len(worse):
                assert not rr.certify_rotation(other, worse[0]).certified
        assert (
            angle_between(rr.refine_rotation(Q + offset, so3_exp([0.02, 0.0, 0.01]) @ found[0]), found[0])
            < 1e-6
        )


def test_free_direction_is_certified_but_not_unique():
    a, b = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]])
    Q = vector_pairs(a, b, np.eye(3))
    R = rr.refine_rotation(Q, np.eye(3))
    np.testing.assert_allclose(R @ a[0], b[0], atol=1e-9)
    certificate = rr.certify_rotation(Q, R)
    assert certificate.certified
    assert abs(certificate.smallest_eigenvalue) < 1e-7
    assert rr.certify_rotation(Q, so3_exp(0.7 * b[0]) @ R).certified
    assert not rr.certify_rotation(Q, so3_exp([0.0, 0.05, 0.0]) @ R).certified


def test_two_equal_optima_are_both_optimal():
    # -R[0, 0]^2 - R[1, 1]^2 - 2 R[2, 2]^2: four rotations (the identity and half turns about the axes) cost -4.
    Q = np.zeros((10, 10))
    Q[0, 0] = Q[4, 4] = -1.0
    Q[8, 8] = -2.0
    for R in (np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])):
        certificate = rr.certify_rotation(Q, R)
        assert certificate.certified
        assert certificate.lower_bound == pytest.approx(-4.0)
    R, gap, tight = rr.solve_rotation_sdp(Q)
    assert tight
    assert gap < 1e-7
    assert float(rr.rotation_cost(Q, R)) == pytest.approx(-4.0)


def test_constant_cost_is_any_rotation():
    Q = np.eye(10)
    assert rr.certify_rotation(Q, np.eye(3)).certified
    assert rr.solve_rotation_sdp(Q).tight


# ---- without the optional solver --------------------------------------------------------------------------


def test_without_clarabel_the_cube_serves_and_says_what_it_proved(monkeypatch):
    monkeypatch.setattr(rr, "find_spec", lambda name: None)
    rng = np.random.default_rng(9)
    for _ in range(10):
        Q = random_symmetric(rng)
        _, costs = optima(Q)
        R, gap, tight = rr.solve_rotation_sdp(Q)
        assert float(rr.rotation_cost(Q, R)) == pytest.approx(costs[0], abs=1e-9)
        assert tight == rr.certify_rotation(Q, R).certified
        assert gap >= 0.0
    monkeypatch.setattr(
        rr,
        "certify_rotation",
        lambda Q, R, tolerance: rr.RotationCertificate(False, -np.inf, np.inf, -np.inf),
    )
    _, gap, tight = rr.solve_rotation_sdp(Q)
    assert not tight
    assert gap == np.inf


def test_cube_covers_all_rotations():
    cube = rr.cube_rotations()
    assert cube.shape == (24, 3, 3)
    some = Rotation.random(300, random_state=4).as_matrix()
    nearest = angle_between(some[:, None], cube[None]).min(axis=1)
    assert np.rad2deg(nearest.max()) < 63.0


# ---- bad input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("Q", "R", "words"),
    [
        (np.eye(9), np.eye(3), r"Q: expected shape \(10, 10\)"),
        (np.full((10, 10), np.nan), np.eye(3), "finite"),
        (np.triu(np.ones((10, 10))), np.eye(3), "symmetric"),
        (np.eye(10), np.eye(4), r"shape \(3, 3\)"),
        (np.eye(10), -np.eye(3), "determinant"),
        (np.eye(10), 1.01 * np.eye(3), "orthonormal"),
        (np.eye(10), np.full((3, 3), np.nan), "orthonormal"),
    ],
)
def test_bad_input_is_named(Q, R, words):
    with pytest.raises(InputError, match=words):
        rr.certify_rotation(Q, R)


def test_generators_match_skew():
    # The Jacobian in Newton's method uses R S(e_k); a sign error there would still descend, only slowly.
    Q = vector_pairs(np.eye(3), np.eye(3) @ so3_exp([0.2, 0.1, -0.3]).T, np.diag([1.0, 2.0, 5.0]))
    R = rr._descend(Q, so3_exp([[0.25, 0.05, -0.2]]), steps=4)[0]
    assert angle_between(R, so3_exp([0.2, 0.1, -0.3])) < 1e-8
    assert skew([1.0, 0.0, 0.0])[2, 1] == 1.0
