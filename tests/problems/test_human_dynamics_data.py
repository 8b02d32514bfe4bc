"""Human dynamics on real recordings: the authors' bowing, published inverse dynamics of walking, squats with a wrong model mass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorgrasp.baselines.inverse_dynamics import inverse_dynamics
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.generalised_forces import coordinate_from_motion, generalised_force
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench, plate_wrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_files import load_coordinates, load_links
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray

Find = Callable[[str], Path]
PLATE = np.array([4.0, 4.0, 9.0, 1.0, 1.0, 1.0])


def plates(path: Path, motion: LinkMotion) -> list[ExternalWrench]:
    """Force plates of an archive as wrenches on the feet, world axes about the origins of the feet; unused plates left out."""
    with np.load(path) as data:
        out = []
        for i, link in enumerate(data["grf_body"]):
            grf = np.asarray(data["grf"][:, i], dtype=float)
            if np.any(grf):
                origin = motion.p[:, motion.link(str(link))]
                values = plate_wrench(grf[:, :3], grf[:, 3:6], grf[:, 6:], origin)
                out.append(
                    ExternalWrench(values, PLATE, link=str(link), frame="world", name=f"plate under {link}")
                )
    return out


def test_bowing_with_the_authors_covariances(dataset: Find) -> None:
    """The MAP keeps to the measured motion at the hip and lets the plate move the ankle; whoever disagrees is named."""
    loadmat = pytest.importorskip("scipy.io").loadmat
    pin = pytest.importorskip("pinocchio")
    raw = loadmat(dataset("mapest_bowing/ExperimentDataset.mat"), squeeze_me=True, struct_as_record=False)
    joints, sensors, place = raw["joints"], raw["sensors"], raw["transform"].urdf_H_imu
    urdf = dataset("mapest_bowing/threeLinkHuman_subject1_sensorExt.urdf")
    tree = PinocchioTree(pin.buildModelFromUrdf(str(urdf)))
    n = joints.q.shape[1]
    motion = tree.motion(np.arange(n) * 0.01, joints.q.T, joints.dq.T, joints.ddq.T)
    assert motion.base == "fixed"
    assert motion.links == ("foot", "leg", "torso")
    measured = [
        Accelerometer(sensors.acc.T, 0.001111, link="torso", R_l_s=place[:3, :3], p_l_s=place[:3, 3]),
        ExternalWrench(sensors.fts_footFrame.T, [59.0, 59.0, 36.0, 2.25, 2.25, 0.56], link="foot"),
    ]
    estimate = solve_frames(HumanDynamics(motion, measured, HumanDynamicsNoise.latella2018()))
    assert estimate.solved
    weight = 61.69 * 9.80665
    assert estimate.external_wrench[:, 0, 2].mean() == pytest.approx(weight, rel=0.01)
    # Top-down (motion alone) and the MAP agree within what the plate can move them.
    top_down = inverse_dynamics(motion).torque
    rms = np.sqrt(np.mean((estimate.torque - top_down) ** 2, axis=0))
    assert rms[1] < 1.5
    assert rms[0] < 7.0
    assert np.ptp(estimate.torque[:, 0]) > 50.0
    assert np.all(estimate.torque_sd[:, 0] < 0.7)
    assert np.all(estimate.torque_sd[:, 1] < 0.2)
    # The accelerometer and the plate both disagree with a two-joint human far beyond their covariances: said, not hidden.
    assert all(found.ratio > 4.0 for found in estimate.innovations)


def test_walking_equals_published_inverse_dynamics(dataset: Find) -> None:
    """Hip and ankle moments within 3 Nm RMS of the published ones, the knee with its translation left aside."""
    path = dataset("opensim_walk_gait2354/links_walk.npz")
    motion = load_links(path)
    noise = HumanDynamicsNoise(
        propagation=1e-4,
        balance=1e-4,
        free_wrench=1e-4,
        link_acceleration=1e-4,
        contact_wrench=(1e4, 1e4, 1e4, 1e4, 1e4, 1e4),
    )
    # The published moments put what motion and plates disagree about on the pelvis: so does a free pelvis.
    estimate = solve_frames(HumanDynamics(motion, plates(path, motion), noise, contacts=("pelvis",)))
    assert estimate.solved
    published, names, t = _storage(dataset("opensim_walk_gait2354/ANSWERS_inverse_dynamics.sto"))
    with np.load(path) as data:
        frames = {
            str(name): np.asarray(data["jR"][:, j], dtype=float) for j, name in enumerate(data["joints"])
        }
    axes = {"hip": np.array([0.0, 0.0, 1.0]), "ankle": np.array([-0.10501355, -0.17402245, 0.97912632])}
    coordinate = {"hip": "hip_flexion_{}_moment", "ankle": "ankle_angle_{}_moment"}
    inside = (motion.t > t[0] + 0.1) & (motion.t < t[-1] - 0.1)
    for joint, axis in axes.items():
        for side in "rl":
            j = estimate.joint_names.index(f"{joint}_{side}")
            ours = np.einsum("nij,j,ni->n", frames[f"{joint}_{side}"], axis, estimate.joint_moment[:, j])
            theirs = np.interp(motion.t, t, published[:, names.index(coordinate[joint].format(side))])
            assert np.sqrt(np.mean((ours - theirs)[inside] ** 2)) < 3.0, (joint, side)


def test_a_knee_that_slides_equals_published_inverse_dynamics(dataset: Find) -> None:
    """Within 1 Nm RMS with the force's share of the coordinate, several times as far off without it; the sd is that of the wrench."""
    path = dataset("opensim_walk_gait2354/links_walk.npz")
    motion, coordinates = load_links(path), load_coordinates(path)
    noise = HumanDynamicsNoise(1e-4, 1e-4, 1e-4, link_acceleration=1e-4, contact_wrench=(1e4,) * 6)
    estimate = solve_frames(HumanDynamics(motion, plates(path, motion), noise, contacts=("pelvis",)))
    published, names, t = _storage(dataset("opensim_walk_gait2354/ANSWERS_inverse_dynamics.sto"))
    inside = (motion.t > t[0] + 0.1) & (motion.t < t[-1] - 0.1)

    def rms(x: FloatArray) -> float:
        return float(np.sqrt(np.mean(x[inside] ** 2)))

    for side in "rl":
        coordinate = coordinate_from_motion(motion, f"knee_{side}", *coordinates[f"knee_angle_{side}"])
        assert coordinate.misfit < 0.01
        found = generalised_force(estimate, coordinate)
        theirs = np.interp(motion.t, t, published[:, names.index(f"knee_angle_{side}_moment")])
        assert rms(found.value - theirs) < 1.0
        assert rms(found.turning - theirs) > 4.0 * rms(found.value - theirs)
        assert np.all((found.sd > 0.1) & (found.sd < 5.0))
    # A joint of three coordinates is not one of one: the misfit tells.
    assert coordinate_from_motion(motion, "hip_r", *coordinates["hip_flexion_r"]).misfit > 0.1


def _squat(dataset: Find) -> tuple[LinkMotion, list[ExternalWrench]]:
    path = dataset("opencap_squat/links_squat.npz")
    whole = load_links(path)
    every = slice(0, len(whole), 6)
    return whole.select(every), [
        sensor.frames(np.arange(len(whole))[every]) for sensor in plates(path, whole)
    ]  # type: ignore[misc]


NOISE = HumanDynamicsNoise(balance=1e-2, link_acceleration=0.1, contact_wrench=(1e4, 1e4, 1e4, 1e3, 1e3, 1e3))


def test_squats_of_the_whole_body(dataset: Find) -> None:
    """Both plates and the arms; that plates and model mass disagree is noticed and said."""
    motion, sensors = _squat(dataset)
    estimate = solve_frames(HumanDynamics(motion, sensors, NOISE))
    assert estimate.solved
    assert len(sensors) == 2
    knee = estimate.joint_moment[:, estimate.joint_names.index("walker_knee_r")]
    assert 20.0 < np.abs(knee).max() < 250.0
    # Make the model 4 kg too heavy: the plates say so.
    mass = motion.mass.copy()
    mass[motion.link("torso")] += 4.0
    heavier = solve_frames(HumanDynamics(replace(motion, mass=mass), sensors, NOISE))
    assert heavier.innovations[0].ratio > 1.5 * estimate.innovations[0].ratio
    assert "disagrees with the model" in heavier.summary()


def test_a_virtual_payload_in_the_hands_is_recovered(dataset: Find) -> None:
    """5 kg added to the hands, its reaction to the plates: found to 0.2 kg above what plates and model disagree about without it."""
    motion, sensors = _squat(dataset)
    hands = ("hand_r", "hand_l")
    loaded = [replace(sensor, values=sensor.values.copy()) for sensor in sensors]
    for sensor, hand in zip(loaded, hands, strict=True):
        i, foot = motion.link(hand), motion.link(sensor.link)
        push = -2.5 * (motion.gravity - motion.acceleration[:, i])
        sensor.values[:, :3] += push
        sensor.values[:, 3:] += np.cross(motion.p[:, i] - motion.p[:, foot], push)
    noise = replace(NOISE, contact_wrench={"default": (1e4, 1e4, 1e4, 1e2, 1e2, 1e2)})
    with_load = ExternalWrenches(motion, loaded, contacts=hands, noise=noise).estimate().payload(hands)
    without = ExternalWrenches(motion, sensors, contacts=hands, noise=noise).estimate().payload(hands)
    assert with_load.mean - without.mean == pytest.approx(5.0, abs=0.2)


def _storage(path: Path) -> tuple[FloatArray, list[str], FloatArray]:
    """Values, column names and times of an OpenSim storage file."""
    lines = path.read_text().splitlines()
    start = lines.index("endheader")
    names = lines[start + 1].split()
    values = np.array([[float(v) for v in line.split()] for line in lines[start + 2 :] if line.strip()])
    return values[:, 1:], names[1:], values[:, 0]
