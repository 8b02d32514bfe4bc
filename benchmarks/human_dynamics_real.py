"""Human dynamics on real recordings beside the peers, on the same frames in the same run: iDynTree's MAP and OpenSim's inverse dynamics."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from metrics import Metric

from factorgrasp.problems.generalised_forces import coordinate_from_motion, generalised_force
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import (
    Accelerometer,
    ExternalWrench,
    JointAcceleration,
    plate_wrench,
)
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.problems.link_motion_files import load_coordinates, load_links
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames
from factorgrasp.typing import FloatArray

WRENCH = (59.0, 59.0, 36.0, 2.25, 2.25, 0.56)
ACCELEROMETER, JOINT, MODEL, PRIOR, FREE = 0.001111, 6.66e-6, 1e-4, 1e4, 1e-6
"""The authors' covariances of the bowing recordings."""
PLATE = np.array([4.0, 4.0, 9.0, 1.0, 1.0, 1.0])


def real(data: Path) -> list[Metric]:
    """Every target on real recordings."""
    out: list[Metric] = []
    for folder, part in (
        ("mapest_bowing", bowing),
        ("opensim_walk_gait2354", walking),
        ("opencap_squat", squats),
    ):
        if not (data / folder).is_dir():
            print(f"{folder} is not in {data}: its rows are left out")
            continue
        try:
            out += part(data / folder)
        except ModuleNotFoundError as error:
            print(f"{folder}: {error.name} is not here")
            out.append(Metric(f"{folder}/peer", float("nan"), "", "lower", 0.0, f"pip install {error.name}"))
    return out


def bowing(folder: Path) -> list[Metric]:
    """Two joints, the authors' covariances: torques and standard deviations of iDynTree's MAP."""
    import pinocchio as pin
    from idyntree_peer import IDynTreePeer, PeerCovariances
    from scipy.io import loadmat

    raw = loadmat(folder / "ExperimentDataset.mat", squeeze_me=True, struct_as_record=False)
    joints, sensors, place = raw["joints"], raw["sensors"], raw["transform"].urdf_H_imu
    urdf = (folder / "threeLinkHuman_subject1_sensorExt.urdf").read_text()
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    names = [str(name) for name in model.names[2:]]
    n, every = joints.q.shape[1], slice(None, None, 5)
    angle, rate, second = (np.asarray(x).T[every] for x in (joints.q, joints.dq, joints.ddq))
    force, specific = sensors.fts_footFrame.T[every], sensors.acc.T[every]
    placed = {"imu": ("torso", place[:3, :3], place[:3, 3])}
    shared = PeerCovariances(MODEL, PRIOR, JOINT, ACCELEROMETER, FREE, {"foot": WRENCH})
    peer = IDynTreePeer(urdf, placed, shared, "foot")
    order = [names.index(peer.model.getJointName(i)) for i in range(len(names))]
    found_d, seconds = [], []
    for f in range(len(angle)):
        y = peer.measurement(
            {"foot": force[f]}, dict(zip(names, second[f], strict=True)), {"imu": specific[f]}
        )
        d, spent = peer.estimate(angle[f][order], rate[f][order], np.zeros(3), y)
        found_d.append(d)
        seconds.append(spent)
    count = len(angle)
    zero = np.zeros((count, 6))
    tree = PinocchioTree(model, gravity=(0.0, 0.0, -9.81))
    q = np.concatenate([zero, np.ones((count, 1)), angle], axis=1)
    motion = tree.motion(
        np.arange(n)[every] * 0.01,
        q,
        np.concatenate([zero, rate], axis=1),
        np.concatenate([zero, second], axis=1),
    )
    measured = [
        Accelerometer(specific, ACCELEROMETER, link="torso", R_l_s=place[:3, :3], p_l_s=place[:3, 3]),
        ExternalWrench(force, WRENCH, link="foot"),
        *(JointAcceleration(second[:, [i]], JOINT, joint=name) for i, name in enumerate(names)),
    ]
    noise = HumanDynamicsNoise(
        MODEL, MODEL, FREE, prior_link_acceleration=PRIOR, prior_external_wrench=PRIOR, prior_joint_wrench=PRIOR,
        prior_joint_acceleration=PRIOR,
    )  # fmt: skip
    problem = HumanDynamics(motion, measured, noise, use_motion=False)
    solve_frames(problem)
    started = time.process_time()
    ours = solve_frames(problem)
    spent = (time.process_time() - started) / count
    axes, where = motion.kinematics().axes, peer.unknowns()
    theirs = np.array([[d[where["wrench", joint]] for joint in ours.joint_names] for d in found_d])
    gap = ours.torque - np.einsum("fji,fji->fj", axes, theirs)
    sd = np.array(
        [
            _peer_sd(peer, angle, rate, force, specific, second, names, order, f, axes[f], ours.joint_names)
            for f in range(0, count, 60)
        ]
    )
    share = ours.torque_sd[::60] / sd
    largest = float(np.abs(share - 1.0).max())
    rms, apart = _rms(gap), float(np.abs(gap).max())
    return [
        Metric(
            "bowing/difference to iDynTree's MAP",
            rms,
            "Nm RMS",
            "lower",
            0.5,
            f"{count} frames; largest {apart:.2g}",
        ),
        Metric(
            "bowing/sd against iDynTree's matrices",
            largest,
            "",
            "lower",
            0.01,
            "relative; it gives no covariance itself",
        ),
        Metric(
            "bowing/time of iDynTree to ours",
            float(np.median(seconds)) / spent,
            "x",
            note=f"ours {1e3 * spent:.4f} ms, covariances included",
        ),
    ]


def _peer_sd(
    peer: object, angle: FloatArray, rate: FloatArray, force: FloatArray, specific: FloatArray, second: FloatArray,
    names: list[str], order: list[int], f: int, axes: FloatArray, joints: tuple[str, ...],
) -> FloatArray:  # fmt: skip
    """Standard deviations of torques from the dense matrices of iDynTree at one frame."""
    from idyntree_peer import IDynTreePeer

    assert isinstance(peer, IDynTreePeer)
    y = peer.measurement({"foot": force[f]}, dict(zip(names, second[f], strict=True)), {"imu": specific[f]})
    peer.estimate(angle[f][order], rate[f][order], np.zeros(3), y)
    D, _, Y, _ = peer.matrices()
    information = D.T @ D / MODEL + (Y.T / peer.sensor_variance) @ Y + np.eye(D.shape[1]) / PRIOR
    P, where = np.linalg.inv(information), peer.unknowns()
    out = []
    for j, joint in enumerate(joints):
        at = where["wrench", joint]
        out.append(np.sqrt(axes[j] @ P[at, at] @ axes[j]))
    return np.array(out)


def walking(folder: Path) -> list[Metric]:
    """OpenSim on the same frames, and the published inverse dynamics."""
    path = folder / "links_walk.npz"
    knees = {f"knee_{s}": f"knee_angle_{s}" for s in "rl"}
    ankles = {f"ankle_{s}": f"ankle_angle_{s}" for s in "rl"}
    ours, spent, t = _ours(path, {**knees, **ankles}, {f"hip_{s}": (f"hip_flexion_{s}", 2) for s in "rl"})
    out = _against_opensim(
        "walk",
        folder / "subject01_simbody.osim",
        folder / "subject01_walk1_grf.xml",
        folder / "subject01_walk1_grf.mot",
        path,
        ours,
        spent,
        3.0,
    )
    lines = (folder / "ANSWERS_inverse_dynamics.sto").read_text().splitlines()
    start = lines.index("endheader")
    names = lines[start + 1].split()
    table = np.array([[float(v) for v in line.split()] for line in lines[start + 2 :] if line.strip()])
    inside = (t > table[0, 0] + 0.1) & (t < table[-1, 0] - 0.1)
    for name, (value, turning) in ours.items():
        theirs = np.interp(t, table[:, 0], table[:, names.index(f"{name}_moment")])
        note = f"range {np.ptp(theirs):.0f} Nm"
        if "knee" in name:
            note += f"; {_rms((turning - theirs)[inside]):.2f} without what the knee slides"
        out.append(
            Metric(
                f"walk/{name} against published", _rms((value - theirs)[inside]), "Nm RMS", "lower", 3.0, note
            )
        )
    return out


def squats(folder: Path) -> list[Metric]:
    """OpenSim on the same frames: whole body with arms."""
    path = folder / "links_squat.npz"
    single = {f"walker_knee_{s}": f"knee_angle_{s}" for s in "rl"} | {
        f"ankle_{s}": f"ankle_angle_{s}" for s in "rl"
    }
    single |= {f"elbow_{s}": f"elbow_flex_{s}" for s in "rl"}
    first = {f"hip_{s}": (f"hip_flexion_{s}", 2) for s in "rl"} | {"back": ("lumbar_extension", 2)}
    ours, spent, _ = _ours(path, single, first)
    files = folder / "optimized_scale_and_markers.osim", folder / "ext_fixed.xml", folder / "squats1_grf.mot"
    return _against_opensim("squat", *files, path, ours, spent, 3.0)


def _ours(
    path: Path, single: Mapping[str, str], first: Mapping[str, tuple[str, int]]
) -> tuple[dict[str, tuple[FloatArray, FloatArray]], float, FloatArray]:
    """Generalised forces (with and without the sliding term) by coordinate, seconds a frame, and times.

    `single` are joints of one coordinate, `first` joints whose first rotation is about an axis of the joint's frame
    in the parent. What motion and
    plates disagree about goes to the pelvis, as inverse dynamics has it.
    """
    motion, coordinates = load_links(path), load_coordinates(path)
    noise = HumanDynamicsNoise(MODEL, MODEL, MODEL, link_acceleration=MODEL, contact_wrench=(1e4,) * 6)
    problem = HumanDynamics(motion, plates(path, motion), noise, contacts=("pelvis",))
    solve_frames(problem)
    started = time.process_time()
    estimate = solve_frames(HumanDynamics(motion, plates(path, motion), noise, contacts=("pelvis",)))
    spent = (time.process_time() - started) / len(motion)
    out = {}
    for joint, name in single.items():
        force = generalised_force(estimate, coordinate_from_motion(motion, joint, *coordinates[name], name))
        out[name] = force.value, force.turning
    with np.load(path) as data:
        frames = {
            str(name): np.asarray(data["jR"][:, j], dtype=float) for j, name in enumerate(data["joints"])
        }
    for joint, (name, axis) in first.items():
        value = np.einsum(
            "ni,ni->n", frames[joint][:, :, axis], estimate.joint_moment[:, estimate.joint_names.index(joint)]
        )
        out[name] = value, value
    return out, spent, motion.t


def plates(path: Path, motion: LinkMotion) -> list[ExternalWrench]:
    """Force plates of an archive that were stepped on."""
    out = []
    with np.load(path) as data:
        for i, link in enumerate(data["grf_body"]):
            grf = np.asarray(data["grf"][:, i], dtype=float)
            if np.any(grf):
                origin = motion.p[:, motion.link(str(link))]
                values = plate_wrench(grf[:, :3], grf[:, 3:6], grf[:, 6:], origin)
                out.append(
                    ExternalWrench(values, PLATE, link=str(link), frame="world", name=f"plate under {link}")
                )
    return out


def _against_opensim(
    name: str, model: Path, loads: Path, forces: Path, path: Path, ours: Mapping[str, tuple[FloatArray, FloatArray]],
    spent: float, target: float
) -> list[Metric]:  # fmt: skip
    from opensim_peer import inverse_dynamics

    coordinates = {key: value for key, (value, _) in load_coordinates(path).items()}
    with np.load(path) as data:
        t = np.asarray(data["t"], dtype=float)
    peer = inverse_dynamics(model, loads, forces, t, coordinates)
    inside = (t > t[0] + 0.1) & (t < t[-1] - 0.1)
    out = []
    for coordinate, (value, turning) in ours.items():
        theirs = np.interp(t, peer.t, peer.force[coordinate])
        note = f"range {np.ptp(theirs[inside]):.0f} Nm"
        if np.any(turning != value):
            note += f"; {_rms((turning - theirs)[inside]):.2f} without the sliding term"
        out.append(
            Metric(
                f"{name}/{coordinate} against OpenSim",
                _rms((value - theirs)[inside]),
                "Nm RMS",
                "lower",
                target,
                note,
            )
        )
    theirs_time = peer.seconds / peer.t.size
    note = f"{1e3 * theirs_time:.2f} ms a frame, kinematics included, to {1e3 * spent:.3f} ms, covariances included"
    out.append(Metric(f"{name}/time of OpenSim to ours", theirs_time / spent, "x", note=note))
    return out


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x**2)))
