"""``kind = "excitation"`` with ``[evaluate]``: what a given trajectory will show of the grasp, and what the wrist will feel."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.excitation_evaluation import Demands, ExcitationEvaluation
from factorgrasp.excitation_measures import noise_matrix, window_measures
from factorgrasp.excitation_motion import ExcitationMotion, TrajectoryStream, read_motion_of
from factorgrasp.excitation_prediction import GraspPrediction, predict_grasp
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.models.robot import frame_id, load_robot
from factorgrasp.models.wrist import WrenchSummary, WristStiffness
from factorgrasp.problems.grasp_pose import checked_gravity
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.provenance import versions
from factorgrasp.recordings import (
    JointStream,
    column_names,
    read_joints,
    read_motion,
    read_poses,
    read_table,
)
from factorgrasp.status import Status
from factorgrasp.toml_tables import check_keys, convert, from_table, get, place, sub_table
from factorgrasp.typing import FloatArray

TABLES = ("evaluate", "robot", "grasp", "human", "noise", "estimate", "prior", "excitation", "solver")
"""[excitation] and [solver] belong to the plan that the trajectory comes from: with [evaluate] added its file evaluates it."""
# Of the plan's human, too: what the wrist wants to do is in the trajectory already.
_HUMAN = (
    "force_stiffness", "moment_stiffness", "comfort_force", "comfort_moment", "max_rotation", "max_force", "max_moment", "mode",
    "position", "rotation_wxyz", "waypoints", "travel", "turn", "goal_position", "goal_rotation_wxyz", "file",
)  # fmt: skip
_ASKED = ("window", "alpha", "rotation_sd", "translation_sd")
Reference = Literal["start", "mean"]
# Hz. Arms move below this; jittered stamps, interpolated, add noise above it that no estimate of white noise takes out.
_BANDWIDTH = 10.0
# Median steps between two samples up to which a trajectory counts as without a gap.
_BRIDGED = 3.1
Columns = Literal["joints", "poses", "motion"]

_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]


class ExcitationEvaluationTask:
    """Measures the excitation of a trajectory.

    Parameters
    ----------
    stream : PoseStream, MotionStream or JointStream
        The end-effector's trajectory, planned or recorded.
    rotation : (3, 3) ndarray
        ``R_r_h``, the grasp at which it is judged; identity by default.
    translation : (3,) ndarray
        ``p_r_h``, m; zero by default. The excitation matrix does not depend on either; the predicted covariance does where the robot's own
        noise counts, and the wrench does.
    known : (6, 6) ndarray, optional
        Covariance of [rotation; translation] that is known before the motion, rad and m.
    noise, settings, prior
        Of the grasp estimator, :class:`factorgrasp.problems.GraspPose`; without ``settings.max_gap`` three missing stamps are
        bridged, and without ``settings.kinematics_bandwidth`` motion above 10 Hz counts as noise.
    gravity : (3,) array_like
        World frame, m/s^2.
    demands : Demands
        Window, and what the motion has to reach.
    wrist : WristStiffness
    reference : {"start", "mean"}
        Which pose the wrist would keep.
    robot_model : pinocchio.Model, optional
        With `frame`, for joints.
    frame : str, optional
    measured_torque : (n, k) array_like, optional
        Nm, compared with the model's.

    Raises
    ------
    InputError
    """

    kind = "excitation_evaluation"

    def __init__(
        self,
        stream: TrajectoryStream,
        rotation: FloatArray | None = None,
        translation: FloatArray | None = None,
        *,
        known: FloatArray | None = None,
        noise: GraspNoise | None = None,
        settings: GraspSettings | None = None,
        prior: GraspPrior | None = None,
        gravity: tuple[float, ...] | FloatArray = (0.0, 0.0, -9.80665),
        demands: Demands | None = None,
        wrist: WristStiffness | None = None,
        reference: Reference = "start",
        robot_model: Any = None,
        frame: str | None = None,
        measured_torque: FloatArray | None = None,
    ) -> None:
        self.noise, self.settings = noise or GraspNoise(), settings or GraspSettings()
        self.prior, self.demands = prior or GraspPrior(), demands or Demands()
        self.rotation = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
        self.translation = np.zeros(3) if translation is None else np.asarray(translation, dtype=float)
        self.known = known
        self.gravity, self.wrist = checked_gravity(gravity), wrist or WristStiffness()
        self.reference: Reference = reference
        if isinstance(stream, JointStream) and (robot_model is None or frame is None):
            raise InputError("[robot] urdf and frame", "both, for joint positions", "none")
        if self.settings.kinematics_bandwidth is None:
            self.settings = replace(self.settings, kinematics_bandwidth=_BANDWIDTH)
        if self.settings.max_gap is None:
            # A commanded trajectory is smooth: stamps that come late are no reason to throw a second of it away.
            self.settings = replace(self.settings, max_gap=_BRIDGED * stream.step)
        self.motion: ExcitationMotion = read_motion_of(
            stream, self.noise, self.settings, self.gravity, robot_model, frame, measured_torque
        )

    def prediction(self) -> GraspPrediction:
        """Covariance that the grasp estimator will state."""
        return predict_grasp(
            self.motion.kinematics,
            self.rotation,
            self.translation,
            self.noise,
            self.settings,
            self.prior,
            self.gravity,
            self.motion.contained,
            self.known,
        )

    def solve(self, solver: str | None = None) -> ExcitationEvaluation:
        """Measure; there is nothing to minimise, so a `solver` is refused.

        Raises
        ------
        InputError
        """
        if solver is not None:
            raise InputError(
                "solver", "none: [evaluate] measures a trajectory and solves nothing", repr(solver)
            )
        began = time.perf_counter()
        motion, kin = self.motion, self.motion.kinematics
        windows = window_measures(
            kin.t,
            kin.angular_velocity,
            kin.angular_acceleration,
            self.demands.window,
            centred=self.settings.accelerometer_bias,
            noise=noise_matrix(kin.angular_velocity, *motion.noise_variances),
        )
        prediction = self.prediction()
        wrench = motion.wrist_wrench(self.translation, self.wrist, self.reference)
        missing = self.demands.missed(windows, prediction)
        seen = prediction.observability
        status, message = Status.SOLVED, ""
        if not seen.complete:
            status = Status.UNOBSERVABLE
            words = "; ".join(f"{d.words} (sd {d.sd:.3g} {d.unit})" for d in seen.missing)
            message = f"The motion does not show: {words}. {seen.advice}"
        elif missing:
            status, message = Status.INFEASIBLE, "The motion is not what was asked for: " + "; ".join(missing)
        estimate = Estimate(
            status,
            self.kind,
            "",
            (),
            {},
            message,
            observability=seen,
            timing={"measure": time.perf_counter() - began},
            versions=versions(("pinocchio",)),
        )
        return ExcitationEvaluation(
            estimate,
            motion,
            windows,
            prediction,
            self.demands,
            wrench,
            None if wrench is None else WrenchSummary.of(wrench),
            self.wrist,
            self.reference,
            self.rotation,
            self.translation,
        )


def build_evaluation(table: Mapping[str, Any], base_dir: Path) -> ExcitationEvaluationTask:
    """The evaluation that a problem file with ``kind = "excitation"`` and a table ``[evaluate]`` asks for.

    Parameters
    ----------
    table : mapping
        The tables of the file.
    base_dir : Path
        Folder that its paths are relative to.

    Raises
    ------
    InputError
        Naming the table and the key, or the file and the column.
    """
    check_keys(table, TABLES, "")
    evaluate, robot = sub_table(table, "evaluate", required=True), sub_table(table, "robot")
    check_keys(
        evaluate,
        ("file", "columns", "check_units", "reference", *_ASKED),
        "[evaluate]",
    )
    if "excitation" in table:
        _check_plan(table)
    else:
        check_keys(robot, ("urdf", "frame", "gravity"), "[robot]")
    asked = {**sub_table(table, "excitation"), **evaluate}
    demands = from_table(Demands, {key: asked[key] for key in _ASKED if key in asked}, "[evaluate]")
    reference = get(evaluate, "reference", Reference, "[evaluate]", "start")
    rotation, translation, known = _grasp(sub_table(table, "grasp"), base_dir)
    noise = from_table(GraspNoise, sub_table(table, "noise"), "[noise]")
    settings = from_table(GraspSettings, sub_table(table, "estimate"), "[estimate]")
    gravity = get(robot, "gravity", _Three, "[robot]", (0.0, 0.0, -9.80665))
    wrist = _wrist(sub_table(table, "human"))
    path = base_dir / get(evaluate, "file", str, "[evaluate]")
    columns = _columns(path, get(evaluate, "columns", Columns, "[evaluate]", None), "urdf" in robot)
    check = get(evaluate, "check_units", bool, "[evaluate]", True)
    model, frame, torque = None, None, None
    stream: TrajectoryStream
    if columns == "joints":
        model = load_robot(base_dir / get(robot, "urdf", str, "[robot]"))
        frame = get(robot, "frame", str, "[robot]")
        frame_id(model, frame)
        stream, torque = _read_joints(path, check)
    else:
        stream = (read_motion if columns == "motion" else read_poses)(path, "trajectory", check)
    prior = _prior(sub_table(table, "prior"))
    return ExcitationEvaluationTask(
        stream,
        rotation,
        translation,
        known=known,
        noise=noise,
        settings=settings,
        prior=prior,
        gravity=gravity,
        demands=demands,
        wrist=wrist,
        reference=reference,
        robot_model=model,
        frame=frame,
        measured_torque=torque,
    )


def _columns(path: Path, stated: Columns | None, with_robot: bool) -> Columns:
    """How the file is read: as it is said, else joints where a robot is given, else by its columns."""
    names = column_names(path)
    fits: list[Columns] = []
    if "q1" in names or "q" in names:
        fits.append("joints")
    if "alx" in names:
        fits.append("motion")
    if "px" in names:
        fits.append("poses")
    if stated is not None:
        if stated not in fits:
            raise InputError(f"{path}: columns", f"those of {stated}", ", ".join(names) or "none")
        return stated
    if not with_robot and fits[1:]:
        # The planner's own files hold joints and poses; without a robot only the poses can be used.
        fits = [kind for kind in fits if kind != "joints"]
    if not fits:
        raise InputError(
            f"{path}: columns",
            "t with q1,...,qn (joints), px,py,pz,qw,qx,qy,qz (poses), or wx,...,alx,...,ax,... (motion)",
            ", ".join(names) or "none",
        )
    return fits[0]


def _read_joints(path: Path, check_units: bool) -> tuple[JointStream, FloatArray | None]:
    """Joint positions and, where the file has them (tau1, ..., or an array tau), torques in Nm."""
    names = column_names(path)
    if path.suffix.lower() == ".npz" and "q1" not in names:
        return _read_arrays(path, check_units)
    stream = read_joints(path, "trajectory", check_units)
    torques = [f"tau{k + 1}" for k in range(stream.q.shape[1])]
    if not all(name in names for name in torques):
        return stream, None
    columns = read_table(path, torques)
    return stream, np.stack([columns[name] for name in torques], axis=1)


def _read_arrays(path: Path, check_units: bool) -> tuple[JointStream, FloatArray | None]:
    """An .npz with arrays t (n,), q (n, k), and qd or dq, qdd or ddq, tau where it has them."""
    with np.load(path, allow_pickle=False) as file:
        if "t" not in file.files:
            raise InputError(f"{path}: arrays", "t and q", ", ".join(file.files))
        arrays = {
            key: np.asarray(file[name], dtype=float)
            for key, known in (("t", ("t",)), ("q", ("q",)), ("qd", ("qd", "dq")), ("qdd", ("qdd", "ddq")), ("tau", ("tau",)))
            for name in known
            if name in file.files
        }  # fmt: skip
    for key, values in arrays.items():
        expected = arrays["q"].shape if key != "t" else (arrays["q"].shape[0],)
        if values.shape != expected or arrays["q"].ndim != 2:
            raise InputError(
                f"{path}: array {key}", f"shape {expected}, with q (n, joints)", f"shape {values.shape}"
            )
    stream = JointStream(
        arrays["t"], arrays["q"], None, arrays.get("qd"), arrays.get("qdd"), "trajectory", check_units
    )
    return stream, arrays.get("tau")


def _check_plan(table: Mapping[str, Any]) -> None:
    """The tables that describe a plan: what they ask for is read, how it was found is not."""
    from factorgrasp.problems.excitation_settings import ExcitationSettings

    from_table(ExcitationSettings, sub_table(table, "excitation"), "[excitation]")


def _grasp(table: Mapping[str, Any], base_dir: Path) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """The grasp at which the motion is judged, and its covariance where the file states one."""
    from factorgrasp.excitation_file import read_grasp

    if not table:
        return np.eye(3), np.zeros(3), None
    stated_place = "translation" in table or "estimate" in table
    belief = read_grasp(table if stated_place else {**table, "translation": [0.0, 0.0, 0.0]}, base_dir)
    stated = any(key in table for key in ("estimate", "covariance", "rotation_sd", "translation_sd"))
    return belief.rotation, belief.translation, belief.covariance if stated else None


def _wrist(table: Mapping[str, Any]) -> WristStiffness:
    where = "[human]"
    check_keys(table, _HUMAN, where)
    known = WristStiffness()
    return WristStiffness(
        get(table, "force_stiffness", float, where, known.translation),
        get(table, "moment_stiffness", float, where, known.rotation),
    )


def _prior(table: Mapping[str, Any]) -> GraspPrior | None:
    if not table:
        return None
    where = "[prior]"
    check_keys(table, ("translation_sd", "rotation_sd", "rotation_wxyz", "translation"), where)
    known: dict[str, Any] = {}
    for key in ("translation_sd", "rotation_sd"):
        if key in table:
            known[key] = get(table, key, float, where)
    if "translation" in table:
        known["translation"] = np.array(convert(table["translation"], _Three, place(where, "translation")))
    if "rotation_wxyz" in table:
        q = np.array(convert(table["rotation_wxyz"], _Four, place(where, "rotation_wxyz")))
        known["rotation"] = quaternion_wxyz_to_matrix(q / max(float(np.linalg.norm(q)), 1e-12))
    return from_table(GraspPrior, {}, where, **known)
