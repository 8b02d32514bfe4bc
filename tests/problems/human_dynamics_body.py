"""A small articulated body for the tests: trunk, two legs with feet, two arms, with ball, hinge and composite joints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from factorgrasp.typing import FloatArray


def body(floating: bool = True, kinds: str = "ball") -> Any:
    """A pinocchio model: pelvis, trunk, thighs, shanks, feet, arms; `kinds` "ball" or "hinges" (three hinges through massless links)."""
    pin = pytest.importorskip("pinocchio")
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -9.80665])
    rng = np.random.default_rng(5)
    root = 0
    if floating:
        root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")

    def inertia(mass: float) -> Any:
        return pin.Inertia.FromBox(mass, 0.2, 0.3, 0.4)

    def place(x: float, y: float, z: float) -> Any:
        return pin.SE3(pin.exp3(0.2 * rng.standard_normal(3)), np.array([x, y, z]))

    def link(joint: int, name: str, mass: float, drop: float) -> int:
        model.appendBodyToJoint(joint, inertia(mass), pin.SE3(np.eye(3), np.array([0.01, 0.02, drop])))
        model.addFrame(pin.Frame(name, joint, 0, pin.SE3.Identity(), pin.FrameType.BODY), False)
        return joint

    def ball(parent: int, name: str, at: Any) -> int:
        if kinds == "ball":
            return int(model.addJoint(parent, pin.JointModelSpherical(), at, name))
        for axis, kind in zip(
            "xyz", (pin.JointModelRX(), pin.JointModelRY(), pin.JointModelRZ()), strict=True
        ):
            parent = model.addJoint(parent, kind, at, f"{name}_{axis}")
            at = pin.SE3.Identity()
        return int(parent)

    link(root, "pelvis", 11.0, 0.05)
    trunk = link(ball(root, "spine", place(0.0, 0.0, 0.1)), "trunk", 28.0, 0.25)
    for side, y in (("left", 0.1), ("right", -0.1)):
        thigh = link(ball(root, f"{side}_hip", place(0.0, y, -0.05)), f"{side}_thigh", 8.0, -0.2)
        knee = model.addJoint(thigh, pin.JointModelRY(), place(0.0, 0.0, -0.42), f"{side}_knee")
        shank = link(knee, f"{side}_shank", 3.5, -0.2)
        link(ball(shank, f"{side}_ankle", place(0.0, 0.0, -0.4)), f"{side}_foot", 1.1, -0.03)
        arm = link(ball(trunk, f"{side}_shoulder", place(0.0, 2 * y, 0.45)), f"{side}_arm", 2.0, -0.15)
        axis = np.array([0.1, 1.0, 0.2])
        elbow = model.addJoint(
            arm,
            pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis)),
            place(0.0, 0.0, -0.3),
            f"{side}_elbow",
        )
        link(elbow, f"{side}_hand", 1.5, -0.15)
    return model


def random_states(model: Any, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unrelated (q, qd, qdd), which the equations of motion do not mind."""
    pin = pytest.importorskip("pinocchio")
    rng = np.random.default_rng(seed)
    v = rng.standard_normal((count, model.nv))
    q = np.array(
        [pin.integrate(model, pin.neutral(model), 0.6 * rng.standard_normal(model.nv)) for _ in range(count)]
    )
    return q, v, 3.0 * rng.standard_normal((count, model.nv))


def smooth_states(
    model: Any, count: int, rate: float = 100.0, seed: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times and consistent (q, qd, qdd) of gentle sines; only for models without a free-flyer or ball joints."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) / rate
    w, phase, size = (rng.uniform(*span, model.nv) for span in ((1.0, 3.0), (0.0, 6.0), (0.1, 0.4)))
    angle = w * t[:, None] + phase
    return t, size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle)


def random_wrenches(links: tuple[str, ...], count: int, seed: int = 1) -> dict[str, FloatArray]:
    """Wrenches (n, 6) of tens of newtons on every one of `links`."""
    rng = np.random.default_rng(seed)
    return {
        link: rng.standard_normal((count, 6)) * np.array([40.0, 40.0, 40.0, 4.0, 4.0, 4.0]) for link in links
    }


def standing(
    count: int = 40, seed: int = 0, carried: dict[str, FloatArray] | None = None
) -> tuple[Any, dict[str, FloatArray]]:
    """A floating body in random motion, with the wrenches on both feet that its motion and what it carries demand (shared at random)."""
    from dataclasses import replace

    from factorgrasp.baselines.inverse_dynamics import inverse_dynamics
    from factorgrasp.problems.link_motion_pinocchio import from_pinocchio

    model = body()
    q, v, a = random_states(model, count, seed)
    motion = replace(from_pinocchio(model, np.arange(count) / 100.0, q, v, a))
    wrenches = {"left_foot": random_wrenches(("left_foot",), count, seed)["left_foot"], **(carried or {})}
    residual = inverse_dynamics(motion, wrenches).root_residual
    root, foot = motion.root, motion.link("right_foot")
    # The root's residual, moved to the right foot.
    F = motion.R[:, root] @ residual[:, :3, None]
    M = motion.R[:, root] @ residual[:, 3:, None]
    arm = motion.p[:, root] - motion.p[:, foot]
    M = M[..., 0] + np.cross(arm, F[..., 0])
    back = np.swapaxes(motion.R[:, foot], 1, 2)
    wrenches["right_foot"] = np.concatenate([(back @ F)[..., 0], (back @ M[..., None])[..., 0]], axis=1)
    return motion, wrenches
