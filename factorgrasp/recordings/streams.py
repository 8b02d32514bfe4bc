"""Plain recordings: time-stamped signals as frozen dataclasses of read-only numpy arrays.

Time is in seconds on the recording's own clock, strictly increasing but not necessarily uniform. A gap is a
row with NaN or a missing stamp; nothing here fills it. ``valid`` tells which rows are complete. Every check
happens at construction, so a stream that exists can be used.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from factorgrasp.errors import InputError
from factorgrasp.lie import quaternion_wxyz_to_matrix
from factorgrasp.recordings import _validate, plausibility
from factorgrasp.recordings.units import STANDARD_GRAVITY
from factorgrasp.typing import FloatArray

# A step longer than this many median steps counts as missing stamps: jitter and one late sample do not.
MISSING_STAMPS_FACTOR = 3.0


@dataclass(frozen=True)
class Gaps:
    """What is missing in a recording.

    Attributes
    ----------
    count : int
        Number of gaps.
    seconds : float
        Time missing in all (s): from the last good sample to the next one, less one median step.
    longest : float
        The longest gap (s).
    intervals : tuple of (float, float)
        For each gap the stamps (s) of the good samples on either side; the recording's own ends at its ends.
    """

    count: int
    seconds: float
    longest: float
    intervals: tuple[tuple[float, float], ...]


class _Stream:
    """What all streams share; the subclasses are the dataclasses."""

    t: FloatArray
    name: str
    check_units: bool
    _time_indexed: ClassVar[tuple[str, ...]] = ()

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Time from the first to the last stamp (s)."""
        return float(self.t[-1] - self.t[0])

    @cached_property
    def step(self) -> float:
        """Median time between samples (s)."""
        return float(np.median(np.diff(self.t)))

    @property
    def rate(self) -> float:
        """Median sampling rate (Hz)."""
        return 1.0 / self.step

    @cached_property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which rows are complete (no NaN in any column), shape (n,)."""
        out = np.ones(self.t.size, dtype=np.bool_)
        for key in self._time_indexed:
            values = getattr(self, key)
            if values is not None:
                out &= np.isfinite(values).all(axis=1)
        out.setflags(write=False)
        return out

    def _derive(self, **changes: object) -> Self:
        # What the whole recording passed, its parts need not pass again: a slice may lie inside a gap, and a
        # hand at rest is still the same sensor. Views of read-only arrays are read-only.
        out = object.__new__(type(self))
        for field in fields(self):  # type: ignore[arg-type]
            out._take(field.name, changes.get(field.name, getattr(self, field.name)))
        return out

    def slice(self, t0: float, t1: float) -> Self:
        """The samples with ``t0 <= t <= t1`` (s)."""
        first, last = np.searchsorted(self.t, t0, "left"), np.searchsorted(self.t, t1, "right")
        if last - first < 2:
            raise InputError(
                f"{self.name}: slice({t0!r}, {t1!r})",
                "at least two samples in the interval",
                f"{max(int(last - first), 0)} of a recording from {self.t[0]:.9g} to {self.t[-1]:.9g} s",
            )
        rows = {
            key: values[first:last]
            for key in ("t", *self._time_indexed)
            if (values := getattr(self, key)) is not None
        }
        return self._derive(**rows)

    def shifted(self, dt: float) -> Self:
        """The same recording on a clock that shows ``dt`` seconds more: ``t + dt``."""
        if not np.isfinite(dt):
            raise InputError(f"{self.name}: shifted(dt)", "a finite time [s]", repr(dt))
        return self._derive(t=_validate.read_only(self.t + dt))

    def gaps(self, max_gap: float | None = None) -> Gaps:
        """Count what is missing: NaN rows and missing stamps.

        Parameters
        ----------
        max_gap : float, optional
            Longest time (s) between two good samples that is no gap: the value with which resampling bridges.
            By default every run of NaN rows counts, and every step longer than three median ones.
        """
        if max_gap is not None and not max_gap > 0.0:
            raise InputError(f"{self.name}: gaps(max_gap)", "a positive time [s]", repr(max_gap))
        good = np.flatnonzero(self.valid)
        if good.size == 0:
            ends = (float(self.t[0]), float(self.t[-1]))
            return Gaps(1, self.duration, self.duration, (ends,))
        limit = MISSING_STAMPS_FACTOR * self.step if max_gap is None else max_gap
        start, end = self.t[good[:-1]], self.t[good[1:]]
        broken = end - start > limit
        if max_gap is None:
            broken |= np.diff(good) > 1
        intervals = [(float(a), float(b)) for a, b in zip(start[broken], end[broken], strict=True)]
        missing = [b - a - self.step for a, b in intervals]
        # At the ends of the recording there is one good neighbour only, so no step to subtract.
        for a, b, rows in (
            (self.t[0], self.t[good[0]], good[0]),
            (self.t[good[-1]], self.t[-1], self.t.size - 1 - good[-1]),
        ):
            if rows > 0 and (max_gap is None or b - a > max_gap):
                at_start = a == self.t[0] and rows == good[0]
                intervals.insert(0 if at_start else len(intervals), (float(a), float(b)))
                missing.append(float(b - a))
        return Gaps(len(intervals), float(sum(missing)), float(max(missing, default=0.0)), tuple(intervals))

    def __setstate__(self, state: dict[str, object]) -> None:
        # Pickling (joblib, copy) forgets that arrays are read-only.
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__.update(state)

    def _take(self, key: str, value: object) -> None:
        object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        missing = len(self) - int(self.valid.sum())
        return (
            f"{type(self).__name__}({self.name!r}, {len(self)} samples, {self.duration:.3f} s "
            f"at {self.rate:.1f} Hz" + (f", {missing} incomplete rows)" if missing else ")")
        )


@dataclass(frozen=True, eq=False, repr=False)
class PoseStream(_Stream):
    """Poses of a body over time.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time (s), strictly increasing, n >= 2.
    position : array_like, shape (n, 3)
        ``p_w_b``, origin of the body in the world (m).
    rotation_wxyz : array_like, shape (n, 4)
        Unit quaternions [w, x, y, z] of ``R_w_b`` (body to world). Kept normalised and with continuous signs.
    name : str
        Who moved; used in messages.
    check_units : bool
        Refuse values that suggest millimetres or milliseconds.

    Raises
    ------
    InputError
        Naming the field, what was expected and what was found (sample numbers count from 0).
    """

    t: FloatArray
    position: FloatArray
    rotation_wxyz: FloatArray
    name: str = "robot"
    check_units: bool = True
    _time_indexed: ClassVar[tuple[str, ...]] = ("position", "rotation_wxyz")

    def __post_init__(self) -> None:
        self._take("t", _validate.times(self.t, f"{self.name}.t"))
        n = self.t.size
        self._take(
            "position", _validate.channels(self.position, f"{self.name}.position", n, ("px", "py", "pz"), "m")
        )
        self._take(
            "rotation_wxyz", _validate.quaternions(self.rotation_wxyz, f"{self.name}.rotation_wxyz", n)
        )
        if self.check_units:
            plausibility.check_rate(self.step, f"{self.name}.t")
            plausibility.check_position(self.position, f"{self.name}.position")

    @cached_property
    def rotation(self) -> FloatArray:
        """``R_w_b`` as matrices, shape (n, 3, 3); NaN in gaps."""
        return _validate.read_only(quaternion_wxyz_to_matrix(self.rotation_wxyz))


@dataclass(frozen=True, eq=False, repr=False)
class ImuStream(_Stream):
    """Gyroscope and accelerometer over time, in the sensor's own frame.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time (s), strictly increasing, n >= 2.
    angular_velocity : array_like, shape (n, 3)
        rad/s, in the body frame.
    specific_force : array_like, shape (n, 3)
        m/s^2, in the body frame: ``f = R_w_b' (a - g)``, which is 9.8 upwards at rest.
    name : str
        Who wore it; used in messages.
    check_units : bool
        Refuse values that suggest degrees, g units, removed gravity or milliseconds.

    Raises
    ------
    InputError
        Naming the field, what was expected and what was found (sample numbers count from 0).

    Notes ----- Slow motion in degrees can look like fast motion in radians. The surer check compares the
    rates of both sides of a grasp and belongs to the problem that has both.
    """

    t: FloatArray
    angular_velocity: FloatArray
    specific_force: FloatArray
    name: str = "hand"
    check_units: bool = True
    _time_indexed: ClassVar[tuple[str, ...]] = ("angular_velocity", "specific_force")

    def __post_init__(self) -> None:
        self._take("t", _validate.times(self.t, f"{self.name}.t"))
        n = self.t.size
        for key, columns, unit in (
            ("angular_velocity", ("wx", "wy", "wz"), "rad/s"),
            ("specific_force", ("ax", "ay", "az"), "m/s^2"),
        ):
            self._take(key, _validate.channels(getattr(self, key), f"{self.name}.{key}", n, columns, unit))
        if self.check_units:
            plausibility.check_rate(self.step, f"{self.name}.t")
            plausibility.check_angular_velocity(self.angular_velocity, f"{self.name}.angular_velocity")
            plausibility.check_specific_force(self.specific_force, f"{self.name}.specific_force")


@dataclass(frozen=True, eq=False, repr=False)
class MotionStream(_Stream):
    """Rigid-body motion as an ideal sensor at the body's origin would read it, all in the body frame.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time (s), strictly increasing, n >= 2.
    angular_velocity : array_like, shape (n, 3)
        ``w`` (rad/s).
    angular_acceleration : array_like, shape (n, 3)
        ``dw/dt`` (rad/s^2).
    specific_force : array_like, shape (n, 3)
        ``f = R_w_b' (a - g)`` (m/s^2).
    rotation_wxyz : array_like, shape (n, 4), optional
        Unit quaternions [w, x, y, z] of ``R_w_b``.
    name : str
        Who moved; used in messages.
    check_units : bool
        Refuse values that suggest degrees, g units, removed gravity or milliseconds.

    Raises
    ------
    InputError
        Naming the field, what was expected and what was found (sample numbers count from 0).
    """

    t: FloatArray
    angular_velocity: FloatArray
    angular_acceleration: FloatArray
    specific_force: FloatArray
    rotation_wxyz: FloatArray | None = None
    name: str = "robot"
    check_units: bool = True
    _time_indexed: ClassVar[tuple[str, ...]] = (
        "angular_velocity",
        "angular_acceleration",
        "specific_force",
        "rotation_wxyz",
    )

    def __post_init__(self) -> None:
        self._take("t", _validate.times(self.t, f"{self.name}.t"))
        n = self.t.size
        for key, columns, unit in (
            ("angular_velocity", ("wx", "wy", "wz"), "rad/s"),
            ("angular_acceleration", ("alx", "aly", "alz"), "rad/s^2"),
            ("specific_force", ("fx", "fy", "fz"), "m/s^2"),
        ):
            self._take(key, _validate.channels(getattr(self, key), f"{self.name}.{key}", n, columns, unit))
        if self.rotation_wxyz is not None:
            self._take(
                "rotation_wxyz", _validate.quaternions(self.rotation_wxyz, f"{self.name}.rotation_wxyz", n)
            )
        if self.check_units:
            plausibility.check_rate(self.step, f"{self.name}.t")
            plausibility.check_angular_velocity(self.angular_velocity, f"{self.name}.angular_velocity")
            plausibility.check_specific_force(self.specific_force, f"{self.name}.specific_force")

    @classmethod
    def from_accelerations(
        cls,
        t: npt.ArrayLike,
        angular_velocity: npt.ArrayLike,
        angular_acceleration: npt.ArrayLike,
        linear_acceleration: npt.ArrayLike,
        rotation_wxyz: npt.ArrayLike,
        gravity: npt.ArrayLike = (0.0, 0.0, -STANDARD_GRAVITY),
        name: str = "robot",
        check_units: bool = True,
    ) -> Self:
        """From kinematics: ``f = a - R_w_b' g``.

        Parameters
        ----------
        t, angular_velocity, angular_acceleration, rotation_wxyz, name, check_units
            As above; the rotation is needed here.
        linear_acceleration : array_like, shape (n, 3)
            Acceleration of the body's origin against the world (m/s^2), gravity not included, expressed in
            the **body** frame.
        gravity : array_like, shape (3,)
            ``g`` in the world frame (m/s^2).
        """
        stamps = _validate.times(t, f"{name}.t")
        a = _validate.channels(
            linear_acceleration, f"{name}.linear_acceleration", stamps.size, ("ax", "ay", "az"), "m/s^2"
        )
        q = _validate.quaternions(rotation_wxyz, f"{name}.rotation_wxyz", stamps.size)
        g = _validate.own(gravity, "gravity")
        if g.shape != (3,) or not np.isfinite(g).all():
            raise InputError("gravity", "three finite numbers in m/s^2, world frame", f"{g!r}")
        f = a - g @ quaternion_wxyz_to_matrix(q)
        return cls(
            stamps,
            np.asarray(angular_velocity, dtype=np.float64),
            np.asarray(angular_acceleration, dtype=np.float64),
            f,
            q,
            name=name,
            check_units=check_units,
        )


@dataclass(frozen=True, eq=False, repr=False)
class JointStream(_Stream):
    """Joint positions over time, with velocities and accelerations where the robot reports them.

    Parameters
    ----------
    t : array_like, shape (n,)
        Time (s), strictly increasing, n >= 2.
    q : array_like, shape (n, k)
        Joint positions (rad; m for prismatic joints).
    names : sequence of str, optional
        One name for each joint; by default q1 ... qk.
    qd, qdd : array_like, shape (n, k), optional
        Joint velocities (rad/s) and accelerations (rad/s^2).
    name : str
        Whose joints; used in messages.
    check_units : bool
        Refuse values that suggest degrees or milliseconds.

    Raises
    ------
    InputError
        Naming the field, what was expected and what was found (sample numbers count from 0).
    """

    t: FloatArray
    q: FloatArray
    names: tuple[str, ...] | None = None
    qd: FloatArray | None = None
    qdd: FloatArray | None = None
    name: str = "robot"
    check_units: bool = True
    _time_indexed: ClassVar[tuple[str, ...]] = ("q", "qd", "qdd")

    def __post_init__(self) -> None:
        self._take("t", _validate.times(self.t, f"{self.name}.t"))
        shape = np.shape(self.q)
        if len(shape) != 2 or shape[1] == 0:
            raise InputError(f"{self.name}.q", "shape (n, joints)", f"shape {shape}")
        names = (
            tuple(f"q{i + 1}" for i in range(shape[1])) if self.names is None else tuple(map(str, self.names))
        )
        if len(names) != shape[1] or len(set(names)) != len(names):
            raise InputError(
                f"{self.name}.names", f"{shape[1]} different names, one for each column of q", f"{names}"
            )
        self._take("names", names)
        for key, unit in (("q", "rad"), ("qd", "rad/s"), ("qdd", "rad/s^2")):
            values = getattr(self, key)
            if values is not None:
                self._take(key, _validate.channels(values, f"{self.name}.{key}", self.t.size, names, unit))
        if self.check_units:
            plausibility.check_rate(self.step, f"{self.name}.t")
            plausibility.check_joint_angle(self.q, f"{self.name}.q")
