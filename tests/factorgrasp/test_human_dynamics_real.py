"""Real recordings through the command line, as a user writes them down."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgrasp import cli, lie
from factorgrasp.problems.human_dynamics import HumanDynamics
from factorgrasp.problems.human_dynamics_sensors import Accelerometer, ExternalWrench
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.solvers.frames import solve_frames

Find = Callable[[str], Path]


def solve(path: Path, text: str, *more: str) -> str:
    path.with_suffix(".toml").write_text('kind = "human_dynamics"\n' + text, encoding="utf-8")
    run = CliRunner().invoke(cli.app, ["solve", str(path.with_suffix(".toml")), "--out", str(path), *more])
    assert run.exit_code == 0, run.output
    return run.output


def write(path: Path, header: str, *columns: object) -> None:
    np.savetxt(path, np.column_stack(columns), "%.17g", ",", header=header, comments="")  # type: ignore[arg-type]


def test_bowing_from_files(dataset: Find, tmp_path: Path) -> None:
    """The authors' q, dq, ddq, accelerometer and plate as tables: the same torques as from arrays."""
    loadmat = pytest.importorskip("scipy.io").loadmat
    pin = pytest.importorskip("pinocchio")
    raw = loadmat(dataset("mapest_bowing/ExperimentDataset.mat"), squeeze_me=True, struct_as_record=False)
    joints, sensors, place = raw["joints"], raw["sensors"], raw["transform"].urdf_H_imu
    urdf = dataset("mapest_bowing/threeLinkHuman_subject1_sensorExt.urdf")
    some = slice(0, 300)
    t = np.arange(joints.q.shape[1])[some] * 0.01
    q, dq, ddq = (np.asarray(x).T[some] for x in (joints.q, joints.dq, joints.ddq))
    acc, plate = np.asarray(sensors.acc).T[some], np.asarray(sensors.fts_footFrame).T[some]
    write(tmp_path / "q.csv", "t,ankle,hip,ankle_dq,hip_dq,ankle_ddq,hip_ddq", t, q, dq, ddq)
    write(tmp_path / "imu.csv", "t,ax,ay,az", t, acc)
    write(tmp_path / "plate.csv", "time,Fx,Fy,Fz,Mx,My,Mz", t, plate)
    wxyz = lie.matrix_to_quaternion_wxyz(np.asarray(place)[None, :3, :3])[0]
    solve(
        tmp_path / "bowing",
        f'[model]\nurdf = "{urdf}"\nfixed_base = true\n[motion]\nfile = "q.csv"\n'
        '[forces]\nfile = "plate.csv"\nlink = "foot"\nframe = "link"\ncolumns = ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]\n'
        "covariance = [59, 59, 36, 2.25, 2.25, 0.56]\n"
        '[[sensors]]\ntype = "accelerometer"\nfile = "imu.csv"\nlink = "torso"\ncovariance = 0.001111\n'
        f"position = {np.asarray(place)[:3, 3].tolist()}\nrotation_wxyz = {wxyz.tolist()}\n"
        "[covariance]\nmodel = 1e-4\nprior = 1e4\njoint_acceleration = 6.66e-6\nfree_wrench = 1e-6\n",
    )
    motion = PinocchioTree(pin.buildModelFromUrdf(str(urdf))).motion(t, q, dq, ddq)
    measured = [
        ExternalWrench(plate, [59.0, 59.0, 36.0, 2.25, 2.25, 0.56], link="foot"),
        Accelerometer(acc, 0.001111, link="torso", R_l_s=place[:3, :3], p_l_s=place[:3, 3]),
    ]
    known = solve_frames(HumanDynamics(motion, measured, HumanDynamicsNoise.latella2018()))
    with np.load(tmp_path / "bowing" / "estimate.npz") as found:
        assert found["joint_names"].tolist() == ["ankle", "hip"]
        assert found["torque"].shape == (300, 2)
        np.testing.assert_allclose(found["torque"], known.torque, atol=1e-4)
        np.testing.assert_allclose(found["torque_sd"], known.torque_sd, rtol=1e-4)


def test_walking_from_its_archive_alone(dataset: Find, tmp_path: Path) -> None:
    """Nothing but the archive: its forces are used without being named, and its mass is the right one."""
    archive = dataset("opensim_walk_gait2354/links_walk.npz")
    output = solve(tmp_path / "walk", f'[motion]\nlinks = "{archive}"\n', "--export", "parquet")
    assert "they agree" in output
    answers = dataset("opensim_walk_gait2354/ANSWERS_links_walk.npz")
    with np.load(tmp_path / "walk" / "estimate.npz") as found, np.load(answers) as reference:
        names = [str(name) for name in reference["joints"]]
        for joint in ("hip_r", "hip_l", "ankle_r", "ankle_l"):
            own = found["joint_moment"][:, found["joint_names"].tolist().index(joint)]
            error = own - reference["joint_moment_world_at_jpos"][:, names.index(joint)]
            # Plates with their usual covariance give way to the model; trusted ones do not (test_human_dynamics_file).
            assert np.sqrt(np.nanmean(error**2)) < 9.0
    silent = solve(tmp_path / "silent", f'[motion]\nlinks = "{archive}"\ngrf = false\n')
    assert "force on" not in silent


def test_squat_with_plates_by_their_columns(dataset: Find, tmp_path: Path) -> None:
    """The storage's own column names, given in two ways; the model's wrong mass is said by weight and by NIS."""
    archive, plates = dataset("opencap_squat/links_squat.npz"), dataset("opencap_squat/squats1_grf.mot")
    columns = [f"ground_force_1_{kind}{axis}" for kind in "vp" for axis in "xyz"] + [
        f"ground_force_1_m{axis}" for axis in "xyz"
    ]
    output = solve(
        tmp_path / "squat",
        f'[model]\nmotion = "{archive}"\n[motion]\nevery = 8\n'
        f'[forces.right]\nfile = "{plates}"\nlink = "calcn_r"\ncolumns = {json.dumps(columns)}\n'
        f'[forces.left]\nfile = "{plates}"\nbody = "calcn_l"\nforce = "ground_force_2_v"\npoint = "ground_force_2_p"\n'
        'torque = "ground_force_2_m"\n',
    )
    assert "the model is too heavy by 3.8 %" in output
    summary = json.loads((tmp_path / "squat" / "estimate.json").read_text(encoding="utf-8"))
    nis = {sensor["name"]: sensor["nis_per_dof"] for sensor in summary["sensors"]}
    assert nis["weight"] > 100.0


def test_squat_with_a_virtual_payload_in_both_hands(dataset: Find, tmp_path: Path) -> None:
    """6 kg in two hands, carried by the right plate: found beside the mass that the model has too much."""
    hands, held = ("hand_r", "hand_l"), 3.0
    with np.load(dataset("opencap_squat/links_squat.npz")) as archive:
        count = archive["t"].shape
        data = {
            name: archive[name][::8] if archive[name].shape[:1] == count else archive[name]
            for name in archive
        }
    grf = data["grf"].astype(float)
    points = []
    for hand in hands:
        i = data["bodies"].tolist().index(hand)
        pull = held * (np.array([0.0, -9.80665, 0.0]) - data["acom"][:, i])
        grf[:, 0, 6:] += np.cross(data["pcom"][:, i] - grf[:, 0, 3:6], -pull)
        grf[:, 0, :3] -= pull
        points.append(f"{hand} = {[float(x) for x in data['com'][i]]}")
    found = {}
    for name, forces in (("without", data["grf"]), ("with", grf)):
        np.savez(tmp_path / f"{name}.npz", **{**data, "grf": forces})
        solve(
            tmp_path / name,
            f'[motion]\nlinks = "{name}.npz"\n[contacts]\nunmeasured = {list(hands)}\npayload = true\n'
            f"points = {{ {', '.join(points)} }}\n[covariance]\nhands = [1e4, 1e4, 1e4, 1, 1, 1]\n",
        )
        with np.load(tmp_path / name / "estimate.npz") as arrays:
            found[name] = np.nanmedian(arrays["payload_mass"])
    assert found["with"] - found["without"] == pytest.approx(2 * held, abs=0.1)
    assert found["without"] == pytest.approx(60.2 - 62.6, abs=0.5)
