"""What can be measured of a moving body: one small class a kind of sensor, each a linear relation ``Y d + b_Y = y`` (mathematics 4.1).

A value of NaN is a gap: its row is dropped in that frame, it is never a zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.typing import BoolArray, FloatArray, IntArray

CovarianceLike = float | Sequence[float] | FloatArray
"""Variances: one for all components, one a component, or a full covariance; a leading axis of frames makes it vary over time."""


@dataclass(frozen=True)
class Sensor:
    """What all sensors have.

    Attributes
    ----------
    values : ndarray
        (n, k) measurements; NaN where there is none.
    covariance : float or array_like
        Variances in squared units of the values: scalar, (k,), (k, k), (n, k) or (n, k, k). An array (k, k) with n == k frames
        is a full covariance.
    name : str
        For reports; made from the kind and the link when empty.
    """

    values: FloatArray
    covariance: CovarianceLike
    name: str = ""

    kind: ClassVar[str] = "sensor"
    unit: ClassVar[str] = ""
    width: ClassVar[int] = 0
    """Number of components; 0 where it depends on the joint."""

    def __post_init__(self) -> None:
        values = np.atleast_2d(np.asarray(self.values, dtype=float))
        object.__setattr__(self, "values", values)
        if not self.name:
            object.__setattr__(self, "name", f"{self.kind} of {self.where}")
        if values.ndim != 2 or (self.width and values.shape[1] != self.width):
            raise InputError(
                f"{self.name}", f"values of shape (n, {self.width or 'k'}) in {self.unit}", str(values.shape)
            )
        if np.any(np.isinf(values)):
            raise InputError(f"{self.name}", f"finite numbers in {self.unit}, NaN for gaps", "infinity")
        self.variances()

    @property
    def where(self) -> str:
        """Name of the link or joint."""
        return str(getattr(self, "link", getattr(self, "joint", "")))

    @property
    def size(self) -> int:
        """Number of components."""
        return int(self.values.shape[1])

    def variances(self) -> FloatArray:
        """The covariance in one of the shapes (k,), (k, k), (n, k), (n, k, k).

        Raises
        ------
        InputError
            When it has none of them, or is not positive.
        """
        known = self.__dict__.get("_checked")
        if known is None:
            known = self._check_covariance()
            object.__setattr__(self, "_checked", known)
        return np.asarray(known)

    def _check_covariance(self) -> FloatArray:
        n, k = self.values.shape
        C = np.asarray(self.covariance, dtype=float)
        if C.ndim == 0:
            C = np.full(k, float(C))
        shapes = ((k,), (k, k), (n, k), (n, k, k))
        if C.shape not in shapes:
            raise InputError(
                f"covariance of {self.name}", f"a scalar or one of the shapes {shapes}", str(C.shape)
            )
        full = C.ndim == 3 or (C.shape == (k, k) and k != 1)
        if not np.all(np.isfinite(C)):
            raise InputError(
                f"covariance of {self.name}",
                "finite variances",
                "NaN or infinity",
                "A gap is a NaN among the values",
            )
        if full:
            try:
                # One that fails here has no square root either, which the estimate needs.
                np.linalg.cholesky(C)
            except np.linalg.LinAlgError:
                raise InputError(
                    f"covariance of {self.name}", "a positive definite matrix", "a singular or indefinite one"
                ) from None
        elif np.any(C <= 0.0):
            raise InputError(
                f"covariance of {self.name}", f"variances above zero in ({self.unit})^2", f"{C.min():.6g}"
            )
        return C

    def frames(self, index: slice | IntArray | BoolArray) -> Sensor:
        """The same sensor at some of the frames."""
        from dataclasses import replace

        k = self.size
        C = np.asarray(self.covariance, dtype=float)
        varies = C.ndim == 3 or (C.ndim == 2 and C.shape != (k, k))
        changed: dict[str, object] = {
            "values": self.values[index],
            "covariance": C[index] if varies else self.covariance,
        }
        return replace(self, **changed)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Accelerometer(Sensor):
    """Specific force at a point of a link, in the sensor's axes: ``R' [alpha_lin - r x dw + w x (v + w x r)]``, m/s^2.

    Attributes
    ----------
    link : str
    R_l_s : ndarray
        (3, 3) sensor to link.
    p_l_s : ndarray
        (3,) the sensor's origin in the link's frame, m.
    """

    link: str = ""
    R_l_s: FloatArray = field(default_factory=lambda: np.eye(3))
    p_l_s: FloatArray = field(default_factory=lambda: np.zeros(3))

    kind: ClassVar[str] = "accelerometer"
    unit: ClassVar[str] = "m/s^2"
    width: ClassVar[int] = 3


@dataclass(frozen=True)
class GyroscopeDerivative(Sensor):
    """Angular acceleration of a link in the sensor's axes (the differentiated gyroscope): ``R' dw``, rad/s^2."""

    link: str = ""
    R_l_s: FloatArray = field(default_factory=lambda: np.eye(3))

    kind: ClassVar[str] = "gyroscope derivative"
    unit: ClassVar[str] = "rad/s^2"
    width: ClassVar[int] = 3


@dataclass(frozen=True)
class ExternalWrench(Sensor):
    """Net external wrench ``[force; moment]`` on a link: force plate, instrumented shoe, or a robot's F/T sensor in the hand.

    Attributes
    ----------
    link : str
    R_l_s, p_l_s : ndarray
        Frame of the values in the link's frame (``frame="sensor"``): the wrench acts on the link and its moment is about `p_l_s`.
    frame : {"sensor", "world"}
        "world": values in world axes, the moment about the link's origin; see :func:`plate_wrench`.
    """

    link: str = ""
    R_l_s: FloatArray = field(default_factory=lambda: np.eye(3))
    p_l_s: FloatArray = field(default_factory=lambda: np.zeros(3))
    frame: Literal["sensor", "world"] = "sensor"

    kind: ClassVar[str] = "external wrench"
    unit: ClassVar[str] = "N, Nm"
    width: ClassVar[int] = 6


@dataclass(frozen=True)
class JointWrench(Sensor):
    """Internal wrench of a joint (parent on child) from a sensor at the joint, in the child's frame, N and Nm."""

    joint: str = ""

    kind: ClassVar[str] = "joint wrench"
    unit: ClassVar[str] = "N, Nm"
    width: ClassVar[int] = 6


@dataclass(frozen=True)
class JointTorque(Sensor):
    """Torques of a joint's degrees of freedom, ``S' f``, Nm (N for a sliding one)."""

    joint: str = ""

    kind: ClassVar[str] = "joint torque"
    unit: ClassVar[str] = "Nm"


@dataclass(frozen=True)
class JointAcceleration(Sensor):
    """Accelerations of a joint's degrees of freedom, such as differentiated angles, rad/s^2 (m/s^2 for a sliding one)."""

    joint: str = ""

    kind: ClassVar[str] = "joint acceleration"
    unit: ClassVar[str] = "rad/s^2"


@dataclass(frozen=True)
class LinkAcceleration(Sensor):
    """Proper spatial acceleration ``alpha`` of a link in its frame, such as from differentiated poses, m/s^2 and rad/s^2."""

    link: str = ""

    kind: ClassVar[str] = "link acceleration"
    unit: ClassVar[str] = "m/s^2, rad/s^2"
    width: ClassVar[int] = 6


@dataclass(frozen=True)
class WrenchSet(Sensor):
    """External wrenches of several links with one covariance that couples them, (n, 6 k), each in its link's frame.

    How the posterior of :class:`factorgrasp.problems.external_wrenches.ExternalWrenches` enters.
    """

    links: tuple[str, ...] = ()

    kind: ClassVar[str] = "external wrenches"
    unit: ClassVar[str] = "N, Nm"

    @property
    def where(self) -> str:
        """Names of the links."""
        return ", ".join(self.links)


@dataclass(frozen=True)
class MomentumRate(Sensor):
    """Rate of the centroidal momentum minus weight, ``sum_i X_G_i* f_i^x``, world axes about the body's centre of mass, N and Nm.

    Measured independently of the links' accelerations, or it counts them twice.
    """

    kind: ClassVar[str] = "centroidal momentum rate"
    unit: ClassVar[str] = "N, Nm"
    width: ClassVar[int] = 6

    @property
    def where(self) -> str:
        """The whole body."""
        return "the body"


def plate_wrench(force: ArrayLike, point: ArrayLike, free_moment: ArrayLike, origin: ArrayLike) -> FloatArray:
    """Wrench (n, 6) in world axes about `origin` from a force plate's force, centre of pressure and free moment.

    Parameters
    ----------
    force : (n, 3) array_like
        On the body, N.
    point : (n, 3) array_like
        Where it acts, m. It may be NaN where the force is zero.
    free_moment : (n, 3) array_like
        Nm.
    origin : (n, 3) or (3,) array_like
        E.g. the origin of the foot, m.
    """
    f, at, m = (np.asarray(v, dtype=float) for v in (force, point, free_moment))
    arm = np.where((f == 0.0).all(axis=-1, keepdims=True), 0.0, at - np.asarray(origin, dtype=float))
    return np.concatenate([f, m + np.cross(arm, f)], axis=-1)
