"""What the online estimator knows at one moment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgrasp import lie
from factorgrasp.observability import Observability, default_words, observe
from factorgrasp.online.events import GraspEvent
from factorgrasp.problems import grasp_words
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import Variable, slices


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
        Stretches without stamps; nothing was put in their place.
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
        s, hand clock minus robot clock; sd 0 when it was given.
    seconds : float
        Data of the present grasp, s.
    events : tuple of GraspEvent
        Regrasps and slips so far (the newest 256).
    robot, hand : StreamCounts
    variables : tuple of Variable
        All unknowns, in the order of `full_covariance`; empty before the first solve.
    values : mapping
        Their values by name; the time offset is what remains beyond the one already applied.
    full_covariance : (n, n) ndarray
    rate_moment : (3, 3) ndarray
        Mean of ``w_r w_r'`` over the present grasp, (rad/s)^2.
    """

    t: float
    status: Status
    message: str
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    time_offset: float
    time_offset_sd: float
    seconds: float
    events: tuple[GraspEvent, ...]
    robot: StreamCounts
    hand: StreamCounts
    variables: tuple[Variable, ...]
    values: State
    full_covariance: FloatArray
    rate_moment: FloatArray

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
    def gyro_bias(self) -> FloatArray:
        """Gyroscope bias (3,), rad/s, hand's sensor frame; zero when it is not estimated."""
        return self._value("gyro_bias")

    @property
    def gyro_bias_sd(self) -> FloatArray:
        """Its standard deviation (3,), rad/s."""
        return self._sd("gyro_bias")

    @property
    def accelerometer_bias(self) -> FloatArray:
        """Accelerometer bias (3,), m/s^2, hand's sensor frame; zero when it is not estimated."""
        return self._value("accelerometer_bias")

    @property
    def accelerometer_bias_sd(self) -> FloatArray:
        """Its standard deviation (3,), m/s^2."""
        return self._sd("accelerometer_bias")

    @cached_property
    def observability(self) -> Observability | None:
        """Directions of the grasp that the motion showed or did not show; None before the first solve."""
        if not self.variables:
            return None
        where, rates = slices(self.variables), self.rate_moment

        def describe(variable: Variable, vector: FloatArray) -> str:
            if variable.name in ("rotation", "translation"):
                return grasp_words.direction(variable.name, vector, rates)
            return default_words(variable, vector)

        return observe(
            self.variables,
            lambda name: self.full_covariance[where[name], where[name]],
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
        if self.variables:
            sd = np.sqrt(np.diag(self.covariance))
            w, x, y, z = self.rotation_wxyz
            turn_sd, way_sd = _triple(np.degrees(sd[:3]), 4), _triple(1e3 * sd[3:], 2)
            lines += [
                f"  rotation R_r_h [w x y z]   {w:.6f} {x:.6f} {y:.6f} {z:.6f}   sd {turn_sd} deg",
                f"  translation p_r_h          {_triple(1e3 * self.translation, 2)} mm   sd {way_sd} mm",
                f"  time offset hand - robot   {1e3 * self.time_offset:.3f} ms   sd {1e3 * self.time_offset_sd:.3f} ms",
                f"  gyroscope bias             {_triple(self.gyro_bias, 5)} rad/s",
                f"  accelerometer bias         {_triple(self.accelerometer_bias, 4)} m/s^2",
            ]
        lines += [f"  {event}" for event in self.events]
        if self.message:
            lines.append(f"  {self.message}")
        return "\n".join(lines)

    def _value(self, name: str) -> FloatArray:
        unknown = np.zeros(3) if self.variables else np.full(3, np.nan)
        return np.asarray(self.values.get(name, unknown))

    def _sd(self, name: str) -> FloatArray:
        if name not in self.values:
            return np.zeros(3) if self.variables else np.full(3, np.inf)
        where = slices(self.variables)[name]
        return np.asarray(np.sqrt(np.diag(self.full_covariance)[where]))


def _triple(values: FloatArray, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)
