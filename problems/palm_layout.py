"""Palm calibration: where the markers are in the wrist frame, from frames with depth, the hand's pose in each of them unknown.

Measured are points ``q_ik = R_k l_i + p_k + nu_ik`` in the camera frame, back-projected from a pixel and a depth, with the covariance that
both give them. Unknown are the layout ``l_i`` and the poses. Only the shape is seen; the frame is a convention (:func:`palm_frame`), held
here by one exact row and by what is not a variable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.losses import Loss
from factorgrasp.models.markers import MarkerLayout
from factorgrasp.typing import FloatArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract

_GAUGE_SD = 1e-8
"""m^2: how exactly the convention holds; the data know nothing of it."""


@dataclass(frozen=True)
class PalmConvention:
    """How a frame is laid into markers.

    Attributes
    ----------
    origin : int
        The wrist marker.
    ahead : int
        The marker on the x axis: that at the middle finger's joint.
    level : tuple of int
        Markers whose heights do not depend on y in the mean, ``sum y z = 0``: those at the fingers' joints, the thumb's left out, since it
        lies below the palm.
    """

    origin: int = 0
    ahead: int = 3
    level: tuple[int, ...] = (2, 3, 4, 5)

    @classmethod
    def of(cls, names: Sequence[str]) -> PalmConvention:
        """The convention for markers by their names; by position (first, then all others) where the names are not those of a palm."""
        names = list(names)
        if "wrist" in names and "middle_mcp" in names:
            level = tuple(
                i for i, name in enumerate(names) if name.endswith("_mcp") and not name.startswith("thumb")
            )
            return cls(names.index("wrist"), names.index("middle_mcp"), level)
        return cls(0, 1, tuple(range(1, len(names))))


def palm_frame(
    points: FloatArray, convention: PalmConvention, up: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The frame W of markers: origin at the wrist marker, x to the middle finger's, z normal to the palm.

    z is that direction normal to x about which the markers at the fingers' joints are level: ``sum y_i z_i = 0`` with the smaller
    ``sum z_i^2``.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        In any frame a.
    convention : PalmConvention
    up : ndarray, shape (3,)
        Roughly z, in a: it decides the sign.

    Returns
    -------
    (ndarray, ndarray)
        ``R_a_w`` (3, 3) and ``p_a_w`` (3,).
    """
    origin = points[convention.origin]
    x = points[convention.ahead] - origin
    x = x / np.linalg.norm(x)
    across = points[list(convention.level)] - origin
    across = across - np.outer(across @ x, x)
    # The least of the two directions across x is the normal.
    _, _, axes = np.linalg.svd(np.vstack([across, 1e3 * x]))
    z = axes[2]
    z = z - (z @ x) * x
    z = z / np.linalg.norm(z)
    z = z if z @ up > 0.0 else -z
    return np.column_stack([x, np.cross(z, x), z]), origin


def in_palm_frame(layout: MarkerLayout, convention: PalmConvention | None = None) -> MarkerLayout:
    """A layout in the frame that :func:`palm_frame` lays into it, its covariance with it (derivatives by central differences)."""
    convention = convention or PalmConvention.of(layout.names)
    up = np.array([0.0, 0.0, 1.0])

    def express(flat: FloatArray) -> FloatArray:
        points = flat.reshape(-1, 3)
        R, p = palm_frame(points, convention, up)
        return np.asarray(((points - p) @ R).ravel())

    flat, step = layout.points.ravel(), 1e-6
    J = np.column_stack(
        [(express(flat + d) - express(flat - d)) / (2.0 * step) for d in step * np.eye(flat.size)]
    )
    covariance = J @ layout.covariance @ J.T
    return MarkerLayout(layout.names, express(flat).reshape(-1, 3), 0.5 * (covariance + covariance.T))


@dataclass(frozen=True, eq=False)
class PalmView:
    """The markers of one frame in the camera frame, labelled.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        m.
    covariance : ndarray, shape (n, 3, 3)
        m^2.
    rotation, position : ndarray
        Start of ``R_c_w`` and ``p_c_w``.
    """

    points: FloatArray
    covariance: FloatArray
    rotation: FloatArray
    position: FloatArray


class PalmLayout:
    """The layout of the markers as a nonlinear problem.

    Variables are ``layout`` (coordinates of all markers but the origin, and x of the marker ahead) and a rotation and a translation for
    each frame.

    Parameters
    ----------
    names : sequence of str
    start : ndarray, shape (n, 3)
        Layout to begin with.
    views : sequence of PalmView
    convention : PalmConvention, optional
    loss : Loss, optional
        On the whitened distance of each point.
    """

    kind = "palm_layout"

    def __init__(
        self,
        names: Sequence[str],
        start: FloatArray,
        views: Sequence[PalmView],
        convention: PalmConvention | None = None,
        loss: Loss | None = None,
    ) -> None:
        if not views:
            raise InputError("palm layout", "at least one frame with all markers", "none")
        self.names, self.views = tuple(names), tuple(views)
        self.convention = convention or PalmConvention.of(self.names)
        R, p = palm_frame(start, self.convention, np.array([0.0, 0.0, 1.0]))
        self._begin = (start - p) @ R
        # The frame moved within the hand, so the poses of the start move with it.
        self._poses = [(view.rotation @ R, view.rotation @ p + view.position) for view in self.views]
        self._free = self._free_coordinates()
        labels = tuple(f"{self.names[i // 3]} {'xyz'[i % 3]}" for i in self._free)
        self.variables = [Variable("layout", self._free.size, "vector", "m", labels, 0.02)]
        for k in range(len(self.views)):
            self.variables.append(Variable(f"rotation {k}", 3, "rotation", "rad"))
            self.variables.append(Variable(f"position {k}", 3, "vector", "m"))
        terms = [
            Term(
                f"view {k}",
                3 * len(self.names),
                ("layout", f"rotation {k}", f"position {k}"),
                Covariance.blocks(view.covariance, f"covariance of view {k}"),
                loss,
                group=3,
                unit="m",
            )
            for k, view in enumerate(self.views)
        ]
        terms.append(Term("frame", 1, ("layout",), Covariance.scalar(_GAUGE_SD**2), unit="m^2"))
        self._system = LeastSquares(self.variables, terms)

    def _free_coordinates(self) -> np.ndarray:
        origin, ahead = self.convention.origin, self.convention.ahead
        fixed = {3 * origin, 3 * origin + 1, 3 * origin + 2, 3 * ahead + 1, 3 * ahead + 2}
        return np.array([i for i in range(3 * len(self.names)) if i not in fixed], dtype=np.intp)

    def points(self, state: State) -> FloatArray:
        """The layout (n, 3) of a state."""
        flat = np.zeros(3 * len(self.names))
        flat[self._free] = state["layout"]
        return flat.reshape(-1, 3)

    def initial_state(self) -> State:
        """The start that was given."""
        out: dict[str, FloatArray] = {"layout": self._begin.ravel()[self._free].copy()}
        for k, (R, p) in enumerate(self._poses):
            out[f"rotation {k}"], out[f"position {k}"] = R.copy(), p.copy()
        return out

    def linearize(self, state: State) -> LeastSquares:
        """Three rows a point in the camera frame, and the row of the convention."""
        layout = self.points(state)
        for k, view in enumerate(self.views):
            R, p = state[f"rotation {k}"], state[f"position {k}"]
            by_layout = np.kron(np.eye(len(self.names)), R)[:, self._free]
            by_rotation = (-R @ lie.skew(layout)).reshape(-1, 3)
            by_position = np.tile(np.eye(3), (len(self.names), 1))
            error = layout @ R.T + p - view.points
            blocks = {"layout": by_layout, f"rotation {k}": by_rotation, f"position {k}": by_position}
            self._system.set_term(f"view {k}", blocks, -error.ravel())
        level = np.array(self.convention.level)
        row = np.zeros((len(self.names), 3))
        row[level, 1], row[level, 2] = layout[level, 2], layout[level, 1]
        value = float(layout[level, 1] @ layout[level, 2])
        self._system.set_term("frame", {"layout": row.reshape(1, -1)[:, self._free]}, np.array([-value]))
        return self._system

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return retract(self.variables, state, step)

    def view(self, estimate: Estimate) -> Estimate:
        """The estimate itself."""
        return estimate

    def layout(self, estimate: Estimate) -> MarkerLayout:
        """The layout of an estimate with its covariance."""
        size = 3 * len(self.names)
        covariance = np.zeros((size, size))
        covariance[np.ix_(self._free, self._free)] = estimate.covariance("layout")
        return MarkerLayout(self.names, self.points(estimate.values), covariance)
