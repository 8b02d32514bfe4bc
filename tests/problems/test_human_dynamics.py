"""Human dynamics: exact against inverse dynamics, equal to the peer, consistent over seeds, gaps as gaps."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorgrasp import solve
from factorgrasp.baselines.inverse_dynamics import inverse_dynamics, original_map, rnea
from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_innovations import propose_covariances
from factorgrasp.problems.human_dynamics_sensors import (
    Accelerometer,
    ExternalWrench,
    GyroscopeDerivative,
    JointAcceleration,
    JointTorque,
    JointWrench,
    LinkAcceleration,
    MomentumRate,
    WrenchSet,
    plate_wrench,
)
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree, from_pinocchio
from factorgrasp.solvers.frames import FrameSolver, solve_frames
from factorgrasp.status import Status
from factorgrasp.uncertainty import nees_band

from .human_dynamics_body import body, random_states, random_wrenches, standing

pin = pytest.importorskip("pinocchio")
TIGHT = HumanDynamicsNoise(1e-6, 1e-6, 1e-6, joint_acceleration=1e-6, link_acceleration=1e-6)


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("kinds", ["ball", "hinges"])
def test_noise_free_torques_equal_rnea(floating: bool, kinds: str) -> None:
    """Within 0.01 Nm of pinocchio's RNEA, for ball joints and chains of hinges, fixed and floating base."""
    model, n = body(floating, kinds), 20
    q, v, a = random_states(model, n)
    wrenches = random_wrenches(("left_foot", "left_hand"), n)
    tau = rnea(model, q, v, a, wrenches)
    sensors = [ExternalWrench(w, 1e-6, link=link) for link, w in wrenches.items()]
    root = tau[:, :6] if floating else np.full((n, 6), np.nan)
    sensors.append(ExternalWrench(root, 1e-6, link="pelvis"))
    motion = from_pinocchio(model, np.arange(float(n)), q, v, a)
    estimate = solve_frames(HumanDynamics(motion, sensors, TIGHT))
    assert estimate.solved
    assert len(estimate.dof_names) == 25 - 6 + 6
    assert np.abs(estimate.torque - tau[:, 6 if floating else 0 :]).max() < 1e-4
    assert np.all(estimate.torque_sd > 0.0)


def test_a_single_frame_takes_any_solver_and_agrees() -> None:
    """The general solvers and the fast one for many frames: same means, same sd, same innovations."""
    motion, wrenches = standing(5)
    sensors = [
        ExternalWrench(w + 0.3, np.diag(np.full(6, 0.5)) + 0.1, link=link) for link, w in wrenches.items()
    ]
    problem = HumanDynamics(motion, sensors, contacts=("left_hand",))
    many = solve_frames(problem)
    for name in ("cholesky", "gtsam"):
        one = solve(problem.at(3), solver=name)
        assert np.allclose(one.torque[0], many.torque[3], atol=1e-7)
        assert np.allclose(one.torque_sd[0], many.torque_sd[3], rtol=1e-6)
        assert np.allclose(one.innovations[0].nis, many.innovations[0].nis[3], rtol=1e-4)
    slow = FrameSolver(problem.pattern, problem.marginals, compiled=False).solve(
        *problem.whitened_frames(slice(0, 2))
    )
    fast = FrameSolver(problem.pattern, problem.marginals).solve(*problem.whitened_frames(slice(0, 2)))
    assert np.allclose(slow.x, fast.x, atol=1e-7)
    assert np.allclose(slow.variances, fast.variances, rtol=1e-6)
    for a, b in zip(slow.marginals, fast.marginals, strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-9)


def test_every_sensor_is_exact_at_the_truth() -> None:
    """All kinds, in odd frames, noise-free: nothing disagrees, and torques are those of inverse dynamics."""
    motion, wrenches = standing(6)
    truth = inverse_dynamics(motion, wrenches)
    n, rng = len(motion), np.random.default_rng(0)
    R, p = pin.exp3(rng.standard_normal(3)), np.array([0.1, -0.2, 0.05])
    hand, trunk = motion.link("left_hand"), motion.link("trunk")
    point = motion.p[:, trunk] + motion.R[:, trunk] @ p
    w, dw = motion.angular_velocity[:, trunk], motion.angular_acceleration[:, trunk]
    arm = point - motion.p[:, trunk]
    specific = (
        motion.acceleration[:, trunk] + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)) - motion.gravity
    )
    into = np.swapaxes(motion.R[:, trunk] @ R, 1, 2)
    foot = motion.link("left_foot")
    world = motion.R[:, foot] @ wrenches["left_foot"].reshape(n, 2, 3).swapaxes(1, 2)
    free = rng.standard_normal((n, 3))
    force, moment = world[..., 0], world[..., 1]
    # A centre of pressure for which plate_wrench must give the moment back: M - free perpendicular to the force is needed.
    across = moment - np.sum(moment * force, axis=1, keepdims=True) * force / np.sum(
        force**2, axis=1, keepdims=True
    )
    at = motion.p[:, foot] + np.cross(force, across) / np.sum(force**2, axis=1, keepdims=True)
    plate = plate_wrench(force, at, moment - across, motion.p[:, foot])
    assert np.allclose(plate[:, 3:], moment)
    assert free.shape == (n, 3)
    right = wrenches["right_foot"]
    shifted = np.concatenate([right[:, :3] @ R, (right[:, 3:] - np.cross(p, right[:, :3])) @ R], axis=1)
    k = motion.kinematics()
    knee = motion.joint("left_knee")
    dof = motion.dof_names.index("left_knee")
    sensors = [
        Accelerometer((into @ specific[..., None])[..., 0], 1e-4, link="trunk", R_l_s=R, p_l_s=p),
        GyroscopeDerivative((into @ dw[..., None])[..., 0], 1e-4, link="trunk", R_l_s=R),
        ExternalWrench(plate, 1e-3, link="left_foot", frame="world"),
        ExternalWrench(shifted, [1e-3] * 6, link="right_foot", R_l_s=R, p_l_s=p),
        JointTorque(truth.torque[:, [dof]], 1e-3, joint="left_knee"),
        JointWrench(truth.joint_wrench[:, knee], 1e-3, joint="left_knee"),
        JointAcceleration(motion.qdd[:, [dof]], 1e-4, joint="left_knee"),
        LinkAcceleration(k.acceleration[:, hand], 1e-4, link="left_hand"),
        WrenchSet(np.zeros((n, 12)), np.eye(12) * 1e-4, links=("left_hand", "right_hand")),
        MomentumRate(motion.momentum_rate, 1e-3),
    ]
    estimate = solve_frames(HumanDynamics(motion, sensors, TIGHT))
    for found in estimate.innovations:
        assert np.all(found.nis < 1e-6), found.name
    assert np.abs(estimate.torque - truth.torque).max() < 1e-3
    assert np.abs(estimate.joint_moment - truth.joint_moment).max() < 1e-3


def test_gaps_drop_their_rows() -> None:
    """NaN is no measurement: as if the sensor were not there in that frame, for plain and for full covariances alike."""
    motion, wrenches = standing(4)
    C = np.diag(np.full(6, 0.5)) + 0.2
    noisy = wrenches["left_foot"] + 3.0
    holes = noisy.copy()
    holes[1] = np.nan
    holes[2, 3:] = np.nan
    right = ExternalWrench(wrenches["right_foot"], 0.5, link="right_foot")
    noise = HumanDynamicsNoise(contact_wrench=1e5)

    def run(values, covariance):  # type: ignore[no-untyped-def]
        problem = HumanDynamics(motion, [ExternalWrench(values, covariance, link="left_foot"), right], noise)
        return problem, solve_frames(problem)

    problem, found = run(holes, C)
    _, whole = run(noisy, C)
    assert np.allclose(found.torque[[0, 3]], whole.torque[[0, 3]], atol=1e-8)
    huge = np.broadcast_to(C, (4, 6, 6)).copy()
    huge[1] = np.eye(6) * 1e13
    huge[2, 3:, :] = huge[2, :, 3:] = 0.0
    huge[2, 3:, 3:] = np.eye(3) * 1e13
    _, loose = run(noisy, huge)
    assert np.allclose(found.torque, loose.torque, atol=1e-3)
    assert np.allclose(found.torque_sd, loose.torque_sd, rtol=1e-4)
    assert list(found.innovation("external wrench of left_foot").dof) == [6, 0, 3, 6]
    one = solve(problem.at(2))
    assert np.allclose(one.torque[0], found.torque[2], atol=1e-7)
    assert np.isnan(one.innovations[0].residual[0, 3:]).all()


def test_a_gap_in_the_motion_is_said_and_stays_one_frame() -> None:
    """A frame without poses has no estimate, a message, and no effect on the others."""
    motion, wrenches = standing(12)
    sensors = [ExternalWrench(w, 0.1, link=link) for link, w in wrenches.items()]
    whole = solve_frames(HumanDynamics(motion, sensors))
    p = motion.p.copy()
    p[5, 2] = np.nan
    found = solve_frames(HumanDynamics(replace(motion, p=p), sensors))
    assert found.status[5] is Status.NUMERICAL_ERROR
    assert "motion of this frame" in found.messages[5]
    assert np.isnan(found.torque[5]).all()
    keep = np.arange(12) != 5
    assert np.allclose(found.torque[keep], whole.torque[keep], atol=1e-8)


def test_consistent_over_seeds() -> None:
    """NEES of torques and of an unmeasured hand's wrench inside the 95 % band; NIS as well."""
    motion, wrenches = standing(
        60, seed=3, carried={"left_hand": random_wrenches(("left_hand",), 60, 9)["left_hand"]}
    )
    truth = inverse_dynamics(motion, wrenches)
    noise = HumanDynamicsNoise(
        1e-3,
        1e-2,
        1e-2,
        contact_wrench=[1600.0] * 3 + [16.0] * 3,
        joint_acceleration=0.25,
        link_acceleration=0.04,
    )
    rng = np.random.default_rng(4)
    n, foot_sd = len(motion), np.array([1.0, 1.0, 2.0, 0.3, 0.3, 0.2])
    tree, k = motion.tree, motion.kinematics()
    # The truth under the noise model: model errors in propagation and balance, real wrenches on "free" links.
    alpha, f = k.acceleration.copy(), np.zeros((n, len(tree.joints), 6))
    qdd = motion.qdd
    first = np.cumsum([0, *(len(d) for d in tree.dofs)])
    fx = {link: np.sqrt(1e-2) * rng.standard_normal((n, 6)) for link in motion.links}
    fx["left_hand"] = wrenches["left_hand"]
    for j in range(len(tree.joints)):
        S = k.subspaces[j]
        alpha[:, tree.children[j]] = (
            (k.transform[:, j] @ alpha[:, tree.parents[j], :, None])[..., 0] + k.bias[:, j]
            + (S @ qdd[:, first[j] : first[j + 1], None])[..., 0] + np.sqrt(1e-3) * rng.standard_normal((n, 6))
        )  # fmt: skip
    from factorgrasp.problems.link_motion_spatial import cross_force

    net = (tree.spatial_inertia @ alpha[..., None])[..., 0] + cross_force(
        k.velocity, (tree.spatial_inertia @ k.velocity[..., None])[..., 0]
    )
    net += np.sqrt(1e-2) * rng.standard_normal(net.shape)
    fx["left_foot"] = wrenches["left_foot"]
    for i, link in enumerate(motion.links):
        if link != "right_foot":
            net[:, i] -= fx[link]
    # The right foot closes the balance: its force travels up to the root unchanged.
    path, link = [], motion.link("right_foot")
    while link != motion.root:
        j = int(np.flatnonzero(tree.children == link)[0])
        path.append(j)
        link = int(tree.parents[j])
    order = sorted(range(len(tree.joints)), reverse=True)
    for j in order:
        f[:, j] = net[:, tree.children[j]]
        net[:, tree.parents[j]] += (np.swapaxes(k.transform[:, j], 1, 2) @ f[:, j, :, None])[..., 0]
    root_left = net[:, motion.root].copy()
    down = root_left
    for j in reversed(path):
        down = np.linalg.solve(np.swapaxes(k.transform[:, j], 1, 2), down[..., None])[..., 0]
        f[:, j] -= down
    fx["right_foot"] = down
    torque = np.concatenate(
        [(np.swapaxes(k.subspaces[j], 1, 2) @ f[:, j, :, None])[..., 0] for j in range(len(tree.joints))],
        axis=1,
    )
    assert np.abs(torque - truth.torque).max() < 20.0
    # What is measured.
    sensors = [
        ExternalWrench(fx[link] + foot_sd * rng.standard_normal((n, 6)), foot_sd**2, link=link)
        for link in ("left_foot", "right_foot")
    ]
    for j, joint in enumerate(tree.joints):
        part = qdd[:, first[j] : first[j + 1]]
        sensors.append(JointAcceleration(part + 0.5 * rng.standard_normal(part.shape), 0.25, joint=joint))
    sensors.append(
        LinkAcceleration(
            alpha[:, motion.root] + 0.2 * rng.standard_normal((n, 6)), 0.04, link=motion.links[motion.root]
        )
    )
    estimate = solve_frames(HumanDynamics(motion, sensors, noise, contacts=("left_hand",)))
    # All torques of a frame together: they share their errors.
    problem = HumanDynamics(motion, sensors, noise, contacts=("left_hand",))
    every = problem.system.columns.joint_wrench.ravel()
    P = FrameSolver(problem.pattern, [every]).solve(*problem.whitened_frames(slice(0, n))).marginals[0]
    reader, at = np.zeros((n, torque.shape[1], every.size)), 0
    for j, S in enumerate(k.subspaces):
        reader[:, at : at + S.shape[2], 6 * j : 6 * j + 6] = np.swapaxes(S, 1, 2)
        at += S.shape[2]
    C, e = reader @ P @ np.swapaxes(reader, 1, 2), estimate.torque - torque
    nees = np.einsum("ni,ni->n", e, np.linalg.solve(C, e[..., None])[..., 0]).mean() / at
    low, high = nees_band(at, n)
    assert low < nees < high
    hand = motion.link("left_hand")
    e = estimate.external_wrench[:, hand] - fx["left_hand"]
    nees = np.sum(e * np.linalg.solve(estimate.external_wrench_covariance[:, hand], e[..., None])[..., 0])
    low, high = nees_band(6, n)
    assert low < nees / (6 * n) < high
    judged = [found for found in estimate.innovations if found.dof.sum()]
    assert len(judged) > 8
    for found in judged:
        # 95 % of all of them together.
        low, high = found.band(probability=1.0 - 0.05 / len(judged))
        assert low < found.ratio < high, (found.name, found.ratio, low, high)


def test_innovations_find_the_sensor_that_is_mistuned() -> None:
    """A plate ten times as noisy as declared: its NIS shows it, and the proposed variance is right."""
    motion, wrenches = standing(300, seed=2)
    rng = np.random.default_rng(7)
    sd = np.array([2.0, 2.0, 2.0, 0.4, 0.4, 0.4])
    left = wrenches["left_foot"] + sd * rng.standard_normal((300, 6))
    right = wrenches["right_foot"] + 0.1 * rng.standard_normal((300, 6))
    sensors = [
        ExternalWrench(left, (sd / 10.0) ** 2, link="left_foot"),
        ExternalWrench(right, 0.01, link="right_foot"),
    ]
    problem = HumanDynamics(motion, sensors, TIGHT)
    estimate = solve_frames(problem)
    assert estimate.innovations[0].ratio > 10.0
    assert "disagrees" in estimate.summary()
    for _ in range(6):
        proposal = propose_covariances(problem, estimate)[0]
        sensors[0] = replace(sensors[0], covariance=proposal.proposed)
        problem = HumanDynamics(motion, sensors, TIGHT)
        estimate = solve_frames(problem)
    assert np.allclose(np.sqrt(proposal.proposed), sd, rtol=0.25)
    assert estimate.innovations[0].ratio == pytest.approx(1.0, abs=0.15)
    assert proposal.samples > 100


def test_original_map_puts_a_load_into_the_joints() -> None:
    """Without a free hand the load goes where it does not belong; with it the torques are right."""
    load = np.tile([0.0, 0.0, -50.0, 0.0, 0.0, 0.0], (20, 1))
    motion, wrenches = standing(20, carried={"left_hand": load})
    truth = inverse_dynamics(motion, wrenches)
    sensors = [ExternalWrench(wrenches[f], 1.0, link=f) for f in ("left_foot", "right_foot")]
    blind = solve_frames(original_map(motion, sensors))
    noise = HumanDynamicsNoise(contact_wrench=(1e6,) * 6)
    seeing = solve_frames(HumanDynamics(motion, sensors, noise, contacts=("left_hand",)))
    assert np.sqrt(np.mean((blind.torque - truth.torque) ** 2)) > 3.0
    assert np.sqrt(np.mean((seeing.torque - truth.torque) ** 2)) < 0.05


@pytest.mark.parametrize("model_variance", [1e-12, 1e-1])
def test_covariances_over_twelve_orders(model_variance: float) -> None:
    """From nearly exact dynamics to loose ones: the same as a dense solution through singular values."""
    motion, wrenches = standing(2)
    sensors = [ExternalWrench(w, 1.0, link=link) for link, w in wrenches.items()]
    problem = HumanDynamics(
        motion, sensors, replace(TIGHT, propagation=model_variance, balance=model_variance)
    )
    estimate = solve_frames(problem)
    A, b = problem.frame(1).whitened()
    x, *_ = np.linalg.lstsq(A.toarray(), b, rcond=1e-18)
    assert estimate.solved
    assert np.allclose(
        estimate.joint_wrench[1].ravel(), x[problem.system.columns.joint_wrench.ravel()], atol=1e-4
    )
    # Variances through the inverse of R of a QR, which squares nothing.
    inverse = np.linalg.inv(np.linalg.qr(A.toarray(), mode="r"))
    sd = np.sqrt(np.sum(inverse**2, axis=1))[problem.system.columns.joint_wrench.ravel()]
    assert np.allclose(estimate.joint_wrench_sd[1].ravel(), sd, rtol=1e-3)


def test_equal_to_idyntree() -> None:
    """The same matrices and covariances as the C++ estimator: the same unknowns to 1e-6 (where it is installed)."""
    pytest.importorskip("idyntree")
    path = Path(__file__).parents[2] / "benchmarks" / "idyntree_peer.py"
    if not path.exists():
        pytest.skip("the benchmarks are not here")
    import sys

    spec = importlib.util.spec_from_file_location("idyntree_peer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["idyntree_peer"] = module
    spec.loader.exec_module(module)
    urdf = _chain_urdf()
    placed = {"imu": ("l3", pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.05, 0.2]))}
    peer = module.IDynTreePeer(
        urdf, placed, module.PeerCovariances(wrench_default=[1.0, 2.0, 3.0, 0.1, 0.2, 0.3]), "l0"
    )
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    rng = np.random.default_rng(0)
    q, qd, y = 0.5 * rng.standard_normal(4), rng.standard_normal(4), 10.0 * rng.standard_normal(peer.measured)
    rate = np.array([0.2, -0.4, 0.3])
    order = [peer.model.getJointName(i) for i in range(4)]
    mine = [str(model.names[i]) for i in range(2, 6)]
    where = [mine.index(name) for name in order]
    d, _ = peer.estimate(q[where], qd[where], rate, y)
    tree = PinocchioTree(model, gravity=(0.0, 0.0, -9.81))
    motion = tree.motion([0.0], np.r_[np.zeros(6), 1.0, q], np.r_[np.zeros(3), rate, qd], np.zeros(10))
    sensors = [
        Accelerometer(
            y[None, peer.ranges["accelerometer", "imu"]],
            1e-3,
            link="l3",
            R_l_s=placed["imu"][1],
            p_l_s=placed["imu"][2],
        )
    ]
    sensors += [
        ExternalWrench(y[None, peer.ranges["wrench", link]], [1.0, 2.0, 3.0, 0.1, 0.2, 0.3], link=link)
        for link in motion.links
    ]
    sensors += [
        JointAcceleration(y[None, peer.ranges["joint", j.name]], 1e-3, joint=j.name) for j in motion.joints
    ]
    found = solve_frames(HumanDynamics(motion, sensors, HumanDynamicsNoise(1e-4, 1e-4), use_motion=False))
    place = peer.unknowns()
    for j, joint in enumerate(motion.joints):
        assert np.abs(found.joint_wrench[0, j] - d[place["wrench", joint.name]]).max() < 1e-6
    for i, link in enumerate(motion.links):
        assert np.abs(found.external_wrench[0, i] - d[place["external", link]]).max() < 1e-6


def _chain_urdf() -> str:
    link = (
        '<link name="l{i}"><inertial><mass value="{m}"/><origin xyz="0.02 0.01 0.2" rpy="0 0 0"/>'
        '<inertia ixx="0.2" iyy="0.25" izz="0.1" ixy="0.01" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="j{i}" type="revolute"><parent link="l{p}"/><child link="l{i}"/><origin xyz="0.05 0 0.4" rpy="0.2 0.1 0"/>'
        '<axis xyz="{a}"/><limit effort="9" velocity="9" lower="-9" upper="9"/></joint>'
    )
    parts = [link.format(i=i, m=3.0 + i) for i in range(5)]
    axes = ("0 1 0", "1 0 0", "0 0 1", "0 1 0")
    parts += [joint.format(i=i, p=(0, 1, 2, 1)[i - 1], a=axes[i - 1]) for i in range(1, 5)]
    return f'<robot name="chain">{"".join(parts)}</robot>'


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda m, n: HumanDynamics(m, [ExternalWrench(np.zeros((n, 6)), 1.0, link="tail")]),
            "link of external wrench of tail",
        ),
        (
            lambda m, n: HumanDynamics(m, [ExternalWrench(np.zeros((n + 1, 6)), 1.0, link="pelvis")]),
            "frames of the motion",
        ),
        (lambda m, n: HumanDynamics(m, contacts=("tail",)), "contacts"),
        (
            lambda m, n: HumanDynamics(
                m, [ExternalWrench(np.zeros((n, 6)), 1.0, link="left_hand")], contacts=("left_hand",)
            ),
            "contacts",
        ),
        (lambda m, n: ExternalWrench(np.zeros((n, 5)), 1.0, link="pelvis"), "shape"),
        (lambda m, n: ExternalWrench(np.zeros((n, 6)), -1.0, link="pelvis"), "variances above zero"),
        (lambda m, n: ExternalWrench(np.full((n, 6), np.inf), 1.0, link="pelvis"), "NaN for gaps"),
        (lambda m, n: ExternalWrench(np.zeros((n, 6)), np.ones((6, 6)), link="pelvis"), "positive definite"),
        (lambda m, n: HumanDynamics(m, [JointTorque(np.zeros((n, 2)), 1.0, joint="left_knee")]), "1 columns"),
        (lambda m, n: HumanDynamics(m, [JointTorque(np.zeros((n, 1)), 1.0, joint="left_kne")]), "joint of"),
        (
            lambda m, n: HumanDynamics(m, noise=HumanDynamicsNoise(propagation={"spine": 1.0})),
            "propagation variance",
        ),
        (lambda m, n: HumanDynamics(m, noise=HumanDynamicsNoise(balance=0.0)), "balance variance"),
        (
            lambda m, n: HumanDynamics(
                m, [Accelerometer(np.zeros((n, 3)), 1.0, link="trunk", R_l_s=2 * np.eye(3))]
            ),
            "R_l_s",
        ),
        (
            lambda m, n: HumanDynamics(m, [Accelerometer(np.zeros((n, 3)), 1.0, link="trunk")] * 2),
            "unique names",
        ),
        (lambda m, n: HumanDynamics(m).least_squares(), "one frame"),
    ],
)
def test_bad_input_is_named(make, words: str) -> None:  # type: ignore[no-untyped-def]
    """One error that says what was expected and what was found."""
    motion, _ = standing(3)
    with pytest.raises(InputError, match=words):
        make(motion, 3)
