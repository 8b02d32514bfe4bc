"""Noise of the configuration in the rows of human dynamics: first-order exact, and consistent over seeds without widened bands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    pose_error_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_point import newton_euler
from factorgrasp.problems.human_dynamics_sensors import ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_state import holders
from factorgrasp.problems.link_motion import StateNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray

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
            world_wrench(truth, link, external[:, truth.link(link)], motion.p[:, truth.link(link)]), 1.0, link=link, frame="world"
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
            names = [name for name in system.terms if name.startswith(("propagation", "balance", "acceleration of", "external wrench"))]
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
