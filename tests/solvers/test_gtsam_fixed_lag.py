"""The fixed-lag smoother against dense linear algebra, and on grasps that wander against the batch solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from factorgrasp import lie, solve
from factorgrasp.errors import NotSolvedError
from factorgrasp.problems import GraspPose, GraspSettings
from factorgrasp.problems.grasp_segments import GraspSegments
from factorgrasp.simulation.cehajic2015 import cehajic2015, grasp_slip
from factorgrasp.solvers.gtsam_fixed_lag import FixedLagSmoother, QuadraticFactor, smooth
from factorgrasp.typing import FloatArray

gtsam = pytest.importorskip("gtsam")

STEPS, SIZE = 12, 2
WALK, NOISE, BIAS = 0.3, 0.2, 0.5


def x(k: int) -> int:
    return int(gtsam.symbol("x", k))


B = int(gtsam.symbol("b", 0))


@dataclass
class Measured:
    """``1/2 |H (x + b) - y|^2 / sd^2`` as a quadratic factor; exact wherever it is made, and counts how often."""

    keys: tuple[int, ...]
    H: FloatArray
    y: FloatArray
    made: int = 0

    def hessian(self, values: Any) -> Any:
        self.made += 1
        A = np.hstack([self.H, self.H]) / NOISE
        b = (self.y - self.H @ (values.atVector(self.keys[0]) + values.atVector(self.keys[1]))) / NOISE
        G, g = A.T @ A, A.T @ b
        n = SIZE
        return gtsam.HessianFactor(*self.keys, G[:n, :n], G[:n, n:], g[:n], G[n:, n:], g[n:], float(b @ b))


class LinearChain:
    """A random walk seen through a shared bias; dense reference for any number of measurements."""

    def __init__(self, seed: int, gain: Any = lambda k: np.eye(SIZE)) -> None:
        rng = np.random.default_rng(seed)
        self.y = rng.normal(size=(STEPS, SIZE)) + 3.0
        self.gains = [np.asarray(gain(k), dtype=float) for k in range(STEPS)]
        self.factors = [
            Measured((x(k), B), H, H @ y) for k, (H, y) in enumerate(zip(self.gains, self.y, strict=True))
        ]

    def increments(self, prior: bool = True) -> Any:
        sigma = gtsam.noiseModel.Isotropic.Sigma
        for k in range(STEPS):
            factors: list[Any] = [self.factors[k]]
            new = gtsam.Values()
            new.insert(x(k), np.full(SIZE, 5.0))
            if k == 0:
                new.insert(B, np.zeros(SIZE))
                factors.append(gtsam.PriorFactorVector(B, np.zeros(SIZE), sigma(SIZE, BIAS)))
                if prior:
                    factors.append(gtsam.PriorFactorVector(x(0), np.ones(SIZE), sigma(SIZE, 1.0)))
            else:
                factors.append(gtsam.BetweenFactorVector(x(k - 1), x(k), np.zeros(SIZE), sigma(SIZE, WALK)))
            yield factors, new, {x(k): float(k), B: float(k)}

    def reference(self, count: int, prior: bool = True) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of [b, x_0, ..., x_(count-1)] given the first `count` increments."""
        n = SIZE * (count + 1)
        eye = np.eye(SIZE)
        rows, rhs = [np.zeros((SIZE, n))], [np.zeros(SIZE)]
        rows[0][:, :SIZE] = eye / BIAS
        for k in range(count):
            here = slice(SIZE * (k + 1), SIZE * (k + 2))
            if k > 0 or prior:
                row = np.zeros((SIZE, n))
                scale = WALK if k else 1.0
                row[:, here] = eye / scale
                if k:
                    row[:, SIZE * k : SIZE * (k + 1)] = -eye / scale
                rows.append(row)
                rhs.append(np.zeros(SIZE) if k else np.ones(SIZE))
            H = self.gains[k]
            row = np.zeros((H.shape[0], n))
            row[:, here] = row[:, :SIZE] = H / NOISE
            rows.append(row)
            rhs.append(H @ self.y[k] / NOISE)
        A, b = np.vstack(rows), np.concatenate(rhs)
        covariance = np.linalg.inv(A.T @ A)
        return covariance @ A.T @ b, covariance


@pytest.mark.parametrize("lag", [np.inf, 3.0])
def test_linear_chain_is_exact_at_any_lag(lag: float) -> None:
    chain = LinearChain(1)
    track = smooth(chain.increments(), lambda k: (x(k), B), FixedLagSmoother(lag))
    for k in range(STEPS):
        # Marginalising a linear system loses nothing: the newest node has all that came before.
        seen = {"newest": k + 1, "lagged": STEPS if np.isinf(lag) else min(k + int(lag) + 1, STEPS)}
        for which, count in seen.items():
            mean, covariance = chain.reference(count)
            columns = np.r_[SIZE * (k + 1) : SIZE * (k + 2), 0:SIZE]
            found = getattr(track, which)[k]
            np.testing.assert_allclose(np.concatenate(found.values), mean[columns], atol=1e-9)
            np.testing.assert_allclose(found.covariance, covariance[np.ix_(columns, columns)], atol=1e-9)
    np.testing.assert_array_equal(track.t, np.arange(STEPS))
    assert np.all(track.seconds > 0.0)


def test_only_variables_within_the_lag_are_kept_and_only_moved_factors_made_again() -> None:
    chain = LinearChain(2)
    smoother = FixedLagSmoother(3.0, relinearize=1e9)
    for increment in chain.increments():
        smoother.update(*increment)
    assert sorted(smoother.values.keys()) == sorted([B, *(x(k) for k in range(STEPS - 4, STEPS))])
    assert [factor.made for factor in chain.factors] == [1] * STEPS
    eager = LinearChain(2)
    smoother = FixedLagSmoother(3.0, relinearize=1e-6)
    for increment in eager.increments():
        smoother.update(*increment)
    assert min(factor.made for factor in eager.factors[:-1]) > 1


def test_what_is_not_determined_waits_for_the_next_increment() -> None:
    # Every second increment measures the first component, the others the second; nothing says where x starts.
    chain = LinearChain(3, gain=lambda k: np.eye(SIZE)[[k % 2]])
    smoother = FixedLagSmoother(4.0)
    done, held = [], []
    for increment in chain.increments(prior=False):
        done.append(smoother.update(*increment))
        held.append(smoother.held)
    assert done == [False] + [True] * (STEPS - 1)
    assert held == [1] + [0] * (STEPS - 1)
    mean, covariance = chain.reference(STEPS, prior=False)
    found = smoother.posterior([x(STEPS - 1), B])
    columns = np.r_[-SIZE:0, 0:SIZE]
    np.testing.assert_allclose(np.concatenate(found.values), mean[columns], atol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance[np.ix_(columns, columns)], atol=1e-8)


def test_an_increment_that_does_not_fit_leaves_the_smoother_as_it_was() -> None:
    chain = LinearChain(4)
    smoother = FixedLagSmoother(4.0)
    increments = list(chain.increments())
    for k, increment in enumerate(increments[:8]):
        assert smoother.update(*increment)
        if k == 6:
            # A variable that nothing measures, in the middle of the stream; then what determines it.
            loose, key = gtsam.Values(), int(gtsam.symbol("z", 0))
            loose.insert(key, np.zeros(SIZE))
            between = gtsam.BetweenFactorVector(
                key, key + 1, np.zeros(SIZE), gtsam.noiseModel.Unit.Create(SIZE)
            )
            loose.insert(key + 1, np.zeros(SIZE))
            assert not smoother.update([between], loose, {key: 6.5, key + 1: 6.5})
            mean, covariance = chain.reference(7)
            found = smoother.posterior([x(6)])
            np.testing.assert_allclose(found.values[0], mean[-SIZE:], atol=1e-9)
            np.testing.assert_allclose(found.covariance, covariance[-SIZE:, -SIZE:], atol=1e-9)
            anchor = gtsam.PriorFactorVector(key, np.ones(SIZE), gtsam.noiseModel.Unit.Create(SIZE))
            assert smoother.update([anchor], gtsam.Values(), {})
            np.testing.assert_allclose(smoother.posterior([key + 1]).values[0], 1.0, atol=1e-9)
    mean, _ = chain.reference(8)
    np.testing.assert_allclose(smoother.posterior([x(7)]).values[0], mean[-SIZE:], atol=1e-9)


def test_errors_of_a_factor_pass_through_and_endless_settling_is_said() -> None:
    class Broken(Measured):
        def hessian(self, values: Any) -> Any:
            raise ZeroDivisionError("the factor's own")

    class Restless(Measured):
        """A cost whose minimum runs away whenever it is made."""

        def hessian(self, values: Any) -> Any:
            self.y = self.y + 1.0
            return super().hessian(values)

    start = gtsam.Values()
    for key in (x(0), B):
        start.insert(key, np.zeros(SIZE))
    prior = [
        gtsam.PriorFactorVector(key, np.zeros(SIZE), gtsam.noiseModel.Unit.Create(SIZE)) for key in (x(0), B)
    ]
    broken = Broken((x(0), B), np.eye(SIZE), np.zeros(SIZE))
    assert isinstance(broken, QuadraticFactor)
    assert not isinstance(prior[0], QuadraticFactor)
    with pytest.raises(ZeroDivisionError):
        FixedLagSmoother().update([broken, *prior], start, {x(0): 0.0, B: 0.0})
    smoother = FixedLagSmoother()
    restless = Restless((x(0), B), np.eye(SIZE), np.zeros(SIZE))
    assert smoother.update([restless, *prior], start, {x(0): 0.0, B: 0.0})
    with pytest.raises(NotSolvedError, match="not settled after 5"):
        smoother.settle(most=5)


# ---- the grasp, segment by segment


@pytest.fixture(scope="module")
def slip() -> Any:
    return grasp_slip(4, at=10.0, time=10.0, angle=np.deg2rad(1.0), distance=0.008, duration=30.0)


def test_static_grasp_fed_incrementally_agrees_with_the_compressed_solver() -> None:
    recording = cehajic2015(2, duration=30.0)
    problem = GraspPose(recording.robot, recording.hand, settings=GraspSettings(check_model=False))
    compressed = solve(problem)
    settled = solve(GraspSegments(problem, static=True)).problem
    smoother = FixedLagSmoother()
    track = smooth(settled.increments(), settled.node_keys, smoother)
    assert len(track.t) == len(settled.factors) == 15
    R, p = track.lagged[-1].values
    assert np.linalg.norm(lie.so3_log(compressed.rotation.T @ R)) < 1e-9
    assert np.linalg.norm(compressed.translation - p) < 1e-9
    # Information alone; the estimate adds what the correction of the robot's noise costs, little here.
    sd, full_sd = (np.sqrt(np.diag(C)) for C in (track.lagged[-1].covariance, compressed.covariance))
    np.testing.assert_allclose(sd, full_sd, rtol=0.02)
    # The first segment, alone, is less sure by far.
    first, last = (np.sqrt(np.trace(track.newest[k].covariance)) for k in (0, -1))
    assert last < 0.3 * first


def test_lag_longer_than_the_recording_is_the_batch_solution(slip: Any) -> None:
    batch = solve(GraspSegments(GraspPose(slip.robot, slip.hand), 1.0, 4e-3, 4e-3))
    segments = batch.problem
    track = smooth(segments.increments(), segments.node_keys, FixedLagSmoother(100.0))
    R = np.stack([node.values[0] for node in track.lagged])
    p = np.stack([node.values[1] for node in track.lagged])
    covariance = np.stack([node.covariance for node in track.lagged])
    assert np.max(lie.angle_between(R, batch.rotation)) < 1e-6
    assert np.max(np.abs(p - batch.translation)) < 1e-6
    np.testing.assert_allclose(track.t, batch.t)
    sd, batch_sd = (np.sqrt(np.einsum("kii->ki", C)) for C in (covariance, batch.covariance))
    np.testing.assert_allclose(sd, batch_sd, rtol=0.02)


def test_short_lag_follows_the_slip_and_waiting_pays(slip: Any) -> None:
    segments = solve(GraspSegments(GraspPose(slip.robot, slip.hand), 1.0, 4e-3, 4e-3)).problem
    track = smooth(segments.increments(), segments.node_keys, FixedLagSmoother(5.0))
    R_true, p_true = slip.truth.grasp_at(track.t)
    errors, nees = {}, {}
    for name in ("newest", "lagged"):
        nodes = getattr(track, name)[3:]
        e = np.stack(
            [
                np.concatenate([lie.so3_log(R.T @ node.values[0]), node.values[1] - p])
                for node, R, p in zip(nodes, R_true[3:], p_true[3:], strict=True)
            ]
        )
        errors[name] = np.sqrt(np.mean(e**2, axis=0))
        nees[name] = (
            np.mean([v @ np.linalg.solve(node.covariance, v) for v, node in zip(e, nodes, strict=True)]) / 6
        )
    assert np.max(errors["lagged"][:3]) < np.deg2rad(0.1)
    assert np.max(errors["lagged"][3:]) < 2.5e-3
    assert np.linalg.norm(errors["lagged"][3:]) < np.linalg.norm(errors["newest"][3:])
    # The slip is faster than the walk for ten seconds and stands still for twenty.
    assert 0.3 < nees["newest"] < 1.6
    assert 0.3 < nees["lagged"] < 1.6
