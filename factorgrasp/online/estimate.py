"""What the online estimator knows at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from factorgrasp import lie
from factorgrasp.observability import Observability, default_words, observe
from factorgrasp.online.events import GraspEvent
from factorgrasp.problems import grasp_words
from factorgrasp.problems.grasp_model import GraspModel
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import Variable


@dataclass(frozen=True)
class StreamCounts:
    """What became of one stream's samples.

    Attributes
    ----------
    received : int
    late : int
        Came more than the stated time after their turn, and were dropped.
    duplicates : int
        Came with the stamp of another sample, and were dropped.
    incomplete : int
        Rows with a NaN: gaps.
    gaps : int
        Missing stretches, whose neighbours were not bridged.
    overflown : int
        Waited for the other stream until there was no room.
    """

    received: int = 0
    late: int = 0
    duplicates: int = 0
    incomplete: int = 0
    gaps: int = 0
    overflown: int = 0


@dataclass(frozen=True)
class OnlineGraspEstimate:
    """The grasp pose now, with an honest covariance.

    Before anything is known the values are NaN and the variances infinite; `status` and `message` say what is missing.

    Attributes
    ----------
    t : float
        Time of the newest data that entered, s, robot clock.
    status : Status
        SOLVED, or UNOBSERVABLE while the motion has not shown all of the grasp.
    message : str
        What is missing and what would help; empty when solved.
    rotation : (3, 3) ndarray
        ``R_r_h``, hand to end-effector.
    translation : (3,) ndarray
        ``p_r_h``, m.
    covariance : (6, 6) ndarray
        Order [rotation; translation]; rotation as right perturbation of ``R_r_h``, rad and m.
    time_offset, time_offset_sd : float
        s, hand clock minus robot clock.
    gyro_bias, gyro_bias_sd, accelerometer_bias, accelerometer_bias_sd : (3,) ndarray
        rad/s and m/s^2, in the hand's sensor frame.
    seconds : float
        Data of the present grasp, s.
    events : tuple of GraspEvent
        Regrasps and slips so far (the newest 256).
    robot, hand : StreamCounts
    """

    t: float
    status: Status
    message: str
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    time_offset: float
    time_offset_sd: float
    gyro_bias: FloatArray
    gyro_bias_sd: FloatArray
    accelerometer_bias: FloatArray
    accelerometer_bias_sd: FloatArray
    seconds: float
    events: tuple[GraspEvent, ...]
    robot: StreamCounts
    hand: StreamCounts
    _model: GraspModel | None = field(default=None, repr=False)
    _state: State | None = field(default=None, repr=False)
    _full: FloatArray | None = field(default=None, repr=False)
    _rate_moment: FloatArray | None = field(default=None, repr=False)

    @property
    def rotation_wxyz(self) -> FloatArray:
        """``R_r_h`` as unit quaternion [w, x, y, z], w >= 0."""
        return lie.matrix_to_quaternion_wxyz(self.rotation)

    @property
    def pose(self) -> FloatArray:
        """``T_r_h`` as a homogeneous matrix (4, 4)."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    @property
    def state(self) -> State:
        """All unknowns by name, sensor errors included; empty before the first solve."""
        return dict(self._state or {})

    @property
    def full_covariance(self) -> FloatArray:
        """Covariance (n, n) of all unknowns, in the order of `state`."""
        return np.zeros((0, 0)) if self._full is None else self._full

    @cached_property
    def observability(self) -> Observability | None:
        """Directions of the grasp that the motion showed or did not show; None before the first solve."""
        if self._model is None or self._full is None or self._rate_moment is None:
            return None
        full, where, rates = self._full, self._model.columns, self._rate_moment

        def describe(variable: Variable, vector: FloatArray) -> str:
            if variable.name in ("rotation", "translation"):
                return grasp_words.direction(variable.name, vector, rates)
            return default_words(variable, vector)

        return observe(
            self._model.variables,
            lambda name: full[where[name], where[name]],
            describe,
            grasp_words.advice(rates, None),
        )

    def error_to(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """``[log(R_r_h' R); p - p_r_h]`` (6,) from this estimate to a grasp, in the coordinates of `covariance`."""
        turn = lie.so3_log(self.rotation.T @ rotation)
        return np.concatenate([turn, np.asarray(translation) - self.translation])

    def summary(self) -> str:
        """A few lines for a terminal."""
        lines = [f"grasp pose at {self.t:.2f} s: {self.status.value}"]
        if self._state is not None:
            sd = np.sqrt(np.diag(self.covariance))
            w, x, y, z = self.rotation_wxyz
            lines += [
                f"  rotation R_r_h [w x y z]   {w:.6f} {x:.6f} {y:.6f} {z:.6f}   sd {_triple(np.degrees(sd[:3]), 4)} deg",
                f"  translation p_r_h          {_triple(1e3 * self.translation, 2)} mm   sd {_triple(1e3 * sd[3:], 2)} mm",
                f"  time offset hand - robot   {1e3 * self.time_offset:.3f} ms   sd {1e3 * self.time_offset_sd:.3f} ms",
                f"  gyroscope bias             {_triple(self.gyro_bias, 5)} rad/s",
                f"  accelerometer bias         {_triple(self.accelerometer_bias, 4)} m/s^2",
            ]
        lines += [f"  {event}" for event in self.events]
        if self.message:
            lines.append(f"  {self.message}")
        return "\n".join(lines)


def _triple(values: FloatArray, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)
