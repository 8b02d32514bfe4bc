"""Noise of the configuration in the rows of human dynamics: first-order exact, and consistent over seeds without widened bands."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.online.human_dynamics import OnlineHumanDynamics
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_point import newton_euler
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_state import holders
from factorgrasp.problems.link_motion import StateNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.simulation.human_dynamics import HumanNoise, human_carrying, human_tpose
from factorgrasp.simulation.human_dynamics_consistency import monte_carlo
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray
from factorgrasp.uncertainty import nees_band

from .human_dynamics_body import body, random_states, random_wrenches

pin = pytest.importorskip("pinocchio")


def world_wrench(motion: Any, link: str, wrench: FloatArray, origin: FloatArray) -> FloatArray:
    """A wrench in its link's true frame as a plate gives it: world axes, about another origin."""
    i = motion.link(link)
    force = (motion.R[:, i] @ wrench[:, :3, None])[..., 0]
    moment = (motion.R[:, i] @ wrench[:, 3:, None])[..., 0]
    return np.concatenate([force, moment + np.cross(motion.p[:, i] - origin, force)], axis=1)


def displaced(size: float, floating: bool) -> tuple[FloatArray, FloatArray]:
    """Residuals of all rows at the truth when the configuration is off by `size`: with and without the unknown error."""
    model = body(floating, "hinges")
    q, _, a = random_states(model, 3)
    v = np.zeros_like(a)
    rng = np.random.default_rng(2)
    delta = size * rng.standard_normal((3, model.nv))
    measured_q = np.array([pin.integrate(model, x, -d) for x, d in zip(q, delta, strict=True)])
    # Exactly: the true configuration is the measured one displaced by delta.
    delta = np.array([pin.difference(model, m, x) for m, x in zip(measured_q, q, strict=True)])
    tree = PinocchioTree(model)
    truth = tree.motion(np.arange(3.0), q, v, a)
    measured_a = a.copy()
    if floating:
        near = tree.motion(np.arange(3.0), measured_q, v, a)
        # The root's acceleration is measured in the world.
        turn = np.swapaxes(near.R[:, near.root], 1, 2) @ truth.R[:, truth.root]
        measured_a[:, :3] = (turn @ a[:, :3, None])[..., 0]
    motion = tree.motion(np.arange(3.0), measured_q, v, measured_a)
    links = ("left_foot", "right_foot", "left_hand")
    wrenches = random_wrenches(links, 3)
    external = np.zeros((3, len(truth.links), 6))
    for link, value in wrenches.items():
        external[:, truth.link(link)] = value
    f, residual = newton_euler(truth.tree, truth.kinematics(), external)
    external[:, truth.root] = residual
    sensors = [
        ExternalWrench(
            world_wrench(truth, link, external[:, truth.link(link)], motion.p[:, truth.link(link)]),
            1.0,
            link=link,
            frame="world",
        )
        for link in (*links, truth.links[truth.root])
    ]
    columns = tree.tangent_columns
    noise = StateNoise(np.full(columns.size, 1.0), 1.0, 1.0, 0.0)
    problem = HumanDynamics(motion.with_state_noise(noise), sensors, HumanDynamicsNoise(1.0, 1.0, 1.0))
    k, out = truth.kinematics(), []
    for error in (delta[:, columns], 0.0 * delta[:, columns]):
        rows = []
        for n in range(3):
            system = problem.frame(n)
            x = np.zeros(system.size)
            where = system.columns

            def put(name: str, value: FloatArray, x: FloatArray = x, where: Any = where) -> None:
                x[where[name]] = value

            for i, link in enumerate(truth.links):
                if acceleration_of(link) in where:
                    put(acceleration_of(link), k.acceleration[n, i])
                put(wrench_on(link), external[n, i])
            ends = np.cumsum([0, *k.sizes])
            for j, joint in enumerate(truth.joints):
                put(wrench_of(joint.name), f[n, j])
                put(joint_acceleration_of(joint.name), k.joint_acceleration[n, ends[j] : ends[j + 1]])
            for name, at in holders(truth.tree):
                put(name, error[n, at])
            names = [
                name
                for name in system.terms
                if name.startswith(("propagation", "balance", "acceleration of", "external wrench"))
            ]
            assert len(names) == 2 * len(truth.links) + 4
            r = system.jacobian.matrix @ x - system.jacobian.rhs
            rows.append(np.concatenate([r[system.jacobian.slices[name]] for name in names]))
        out.append(np.array(rows))
    return out[0], out[1]


@pytest.mark.parametrize("floating", [True, False])
def test_rows_are_right_to_first_order(floating: bool) -> None:
    """Residuals at the truth shrink with the square of the error, and are far from it without the unknown error."""
    big, small = displaced(1e-3, floating)[0], displaced(1e-4, floating)[0]
    blind = displaced(1e-4, floating)[1]
    assert np.abs(small).max() < 2e-2 * np.abs(big).max()
    assert np.abs(small).max() < 1e-2 * np.abs(blind).max()


@pytest.mark.parametrize(
    ("make", "hands", "seeds"),
    [
        (human_tpose, (), 1),
        (partial(human_tpose, payload=5.0), ("RightHand",), 1),
        (partial(human_carrying, motion="walking", payload=0.0, noise=HumanNoise(bandwidth=9.0)), (), 1),
    ],
)
def test_consistent_over_seeds(make: Any, hands: tuple[str, ...], seeds: int) -> None:
    """All torques together, wrenches, and a payload inside the 95 % band of independent frames; with poses taken to
    be exact, torques are not."""
    found = monte_carlo(make, range(seeds), hands)
    for one in found.values():
        assert one.inside, (one.name, one.ratio, one.band)
    assert found["torques"].dof > 1500
    assert monte_carlo(make, range(1), hands, state_noise=False)["torques"].ratio > 1.5


def test_wrenches_by_momentum_are_consistent() -> None:
    """The two-task estimate: feet, what the hand carries and the payload inside their bands."""
    wrench, payload, plain = [], [], []
    for seed in range(5):
        recording = human_tpose(seed, payload=5.0)
        motion, keep, own = recording.measured_motion
        frames = np.arange(0, len(motion), recording.filter_window)
        at, part = np.flatnonzero(keep)[frames], motion.select(frames)
        sensors = recording.foot_sensors(part, at)
        noise = replace(own, free_wrench=1e-8, contact_wrench=(1e4, 1e4, 1e4, 1e2, 1e2, 1e2))
        links = ("RightFoot", "LeftFoot", "RightHand")
        truth = np.concatenate([recording.truth.external_wrench[link][at] for link in links], axis=1)
        for moving in (part.with_state_noise(recording.state_noise), part):
            found = ExternalWrenches(moving, sensors, ("RightHand",), noise).estimate()
            # The hand's moment is mostly the prior's.
            e = (np.concatenate([found.of(link) for link in links], axis=1) - truth)[:, :15]
            P = found.joint_covariance(links)[:, :15, :15]
            load = found.payload()
            if moving is part:
                plain.append(((load.mass - 5.0) / load.sd) ** 2)
                continue
            wrench.append(np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0]))
            payload.append(((load.mass - 5.0) / load.sd) ** 2)
    scores = np.concatenate(wrench)
    low, high = nees_band(15, scores.size)
    assert low < scores.mean() / 15.0 < high
    scores = np.concatenate(payload)
    low, high = nees_band(1, scores.size)
    assert low < scores.mean() < high
    assert np.concatenate(plain).mean() > 2.0


def test_covariances_of_a_state_may_be_full_and_vary() -> None:
    """A full covariance that is diagonal, and one a frame, give the same as variances; a correlated one does not."""
    recording = human_tpose()
    motion, keep, own = recording.measured_motion
    part, at = motion.select(np.arange(4)), np.flatnonzero(keep)[:4]
    noise, sensors = recording.state_noise, recording.foot_sensors(part, at)
    k = noise.size
    mixed = np.diag(noise.covariance)
    mixed[0, 4] = mixed[4, 0] = 0.8 * np.sqrt(mixed[0, 0] * mixed[4, 4])
    shapes = (
        noise.covariance,
        np.diag(noise.covariance),
        np.tile(noise.covariance, (4, 1)),
        np.tile(np.diag(noise.covariance), (4, 1, 1)),
    )
    sd = [
        solve_frames(
            HumanDynamics(part.with_state_noise(replace(noise, covariance=C)), sensors, own)
        ).torque_sd
        for C in (*shapes, mixed)
    ]
    for other in sd[1:4]:
        assert np.allclose(other, sd[0], rtol=1e-6)
    assert np.abs(sd[4] / sd[0] - 1.0).max() > 1e-3
    assert part.with_state_noise(noise).select([1, 2]).state_noise is noise
    for bad, words in (
        (np.ones(k - 1), f"{k} components"),
        (-np.ones(k), "positive definite"),
        (np.ones((7, k)), "4 frames"),
    ):
        with pytest.raises(InputError, match=words):
            part.with_state_noise(StateNoise(bad))
    with pytest.raises(InputError, match="gains"):
        StateNoise(np.ones(k), 0.0)
    with pytest.raises(InputError, match="cross"):
        StateNoise(np.ones(k), 1.0, 1.0, 2.0)


def test_a_stream_knows_the_noise_of_the_state() -> None:
    """Frame by frame the same as all at once."""
    recording = human_tpose(payload=5.0)
    motion, keep, own = recording.measured_motion
    part, at = (
        motion.select(np.arange(300, 306)).with_state_noise(recording.state_noise),
        np.flatnonzero(keep)[300:306],
    )
    sensors = recording.foot_sensors(part, at)
    batch = solve_frames(HumanDynamics(part, sensors, own, ("RightHand",)))
    tree = PinocchioTree(recording.body.model())
    online = OnlineHumanDynamics(tree, sensors, own, ("RightHand",), state_noise=recording.state_noise)
    for f in range(6):
        values = {s.name: s.values[f] for s in sensors}
        got = online.step_links(float(f), part.kinematics(slice(f, f + 1)), values)
        # The last frame's wrenches stand for this one's, which is as good to second order.
        assert np.allclose(got.torque, batch.torque[f], atol=1e-2)
        assert np.allclose(got.torque_sd, batch.torque_sd[f], rtol=2e-2)
