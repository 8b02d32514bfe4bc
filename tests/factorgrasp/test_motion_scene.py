"""Pictures of a motion: files of the right kind, and a scene that is where the arm is."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from factorgrasp import plots
from factorgrasp.errors import InputError
from factorgrasp.excitation_exports import export_names, write_exports
from factorgrasp.excitation_plots import draw_margins, draw_wrench
from factorgrasp.joint_trajectory import JointTrajectory
from factorgrasp.models.arm import seven_axis_arm
from factorgrasp.motion_scene import MotionScene, animate, save_rrd, strip
from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop
from factorgrasp.simulation.grasp_loop_figures import draw_convergence, spring_force

LEVER = np.array([0.4, 0.1, 0.0])


@pytest.fixture(scope="module")
def scene() -> MotionScene:
    arm = seven_axis_arm()
    t = np.arange(0.0, 1.0, 0.05)
    q = arm.start + 0.1 * np.sin(t)[:, None]
    return MotionScene.of_joints(t, q, arm.model, arm.frame, LEVER, np.ones((t.size, 3)))


def test_scene_is_where_the_arm_is(scene: MotionScene) -> None:
    arm = seven_axis_arm()
    R, p = arm.placement(arm.start + 0.1 * np.sin(scene.t[7]))
    np.testing.assert_allclose(scene.position[7], p, atol=1e-12)
    np.testing.assert_allclose(scene.hand[7], p + R @ LEVER, atol=1e-12)
    np.testing.assert_allclose(scene.skeleton[7, -1], p, atol=1e-12)
    # The first joint stands on its base.
    np.testing.assert_allclose(scene.skeleton[:, 0], np.tile([0.0, 0.0, 0.33], (scene.t.size, 1)))
    assert len(scene.every(0.2).t) == 5


def test_animation_and_strip(scene: MotionScene, tmp_path: Path) -> None:
    moving = animate(scene, tmp_path / "a.gif", rate=4.0, width=2.0)
    assert moving.read_bytes()[:6] == b"GIF89a"
    assert strip(scene, tmp_path / "a.png", (0.0, 0.5)).read_bytes()[:4] == b"\x89PNG"
    assert {path.name for path in tmp_path.iterdir()} == {"a.gif", "a.png"}
    with pytest.raises(InputError, match=r"\.gif"):
        animate(scene, tmp_path / "a.mp4")


def test_recording_for_rerun(scene: MotionScene, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    assert save_rrd(scene, tmp_path / "a.rrd").read_bytes()[:4] == b"RRF2"


def test_curves_of_a_run(tmp_path: Path) -> None:
    run = cehajic2015_loop(0, duration=1.0, arm=False)
    draw_convergence({"one": run}, tmp_path / "c.png")
    assert (tmp_path / "c.png").stat().st_size > 5000
    made, axes = plots.figure(4.0, 3.0, rows=2)
    draw_wrench(axes[0], run.t, run.wrench, 0)
    draw_margins(axes[1], {"velocity": 0.4, "torque": 1.2})
    assert "torque" in plots.to_svg(made, "test")


def test_springs_of_the_printed_motion() -> None:
    # The chord of the printed turn of 92 deg at 0.556 m from its axis, by hand.
    turn = 2.0 * np.deg2rad(np.linalg.norm([10.0, 40.0, 20.0]))
    axis = np.array([10.0, 40.0, 20.0]) / np.linalg.norm([10.0, 40.0, 20.0])
    error = np.array([0.61, 0.16, 0.08])
    off = error - axis * (axis @ error)
    peak, _ = spring_force((0.5, 0.0, 0.0), 150.0)
    assert peak == pytest.approx(150.0 * 2.0 * np.sin(0.5 * turn) * np.linalg.norm(off), rel=1e-3)


def test_planner_s_arm_and_ours_are_written_alike(tmp_path: Path) -> None:
    """The trajectory of a plan in joint space, as a ROS message and as pictures."""
    arm = seven_axis_arm()
    t = np.arange(0.0, 1.0, 0.01)
    q = arm.start + 0.05 * np.sin(t)[:, None]
    robot = SimpleNamespace(model=arm.model)
    problem = SimpleNamespace(
        arm=SimpleNamespace(robot=robot, frame="grasp"), grasp=SimpleNamespace(translation=LEVER)
    )
    zero = np.zeros_like(q)
    plan = SimpleNamespace(
        t=t, q=q, qd=zero, qdd=zero, tau=zero, wrench=np.zeros((t.size, 6)), problem=problem
    )
    write_exports(plan, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(export_names(plan))
    back = JointTrajectory.load(tmp_path / "joint_trajectory.yaml")
    assert back.names == tuple(f"joint{k}" for k in range(1, 8))
    np.testing.assert_array_equal(back.positions[-1], q[-1])
