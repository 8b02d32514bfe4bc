"""Inequalities that physics puts on contacts and joints (mathematics 4.5): rows ``G d <= h`` of one frame.

Contacts are described by a frame on the link, at the sole or palm: z is the inward normal, along which the surroundings push on the body.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.least_squares import Constraint
from factorgrasp.problems.human_dynamics_names import wrench_of, wrench_on
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.problems.link_motion_spatial import skew
from factorgrasp.typing import FloatArray, IntArray


@dataclass(frozen=True)
class DynamicsConstraint(ABC):
    """What all constraints offer; see the classes below."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Unique within a problem."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of a row."""

    @abstractmethod
    def row_pattern(self, tree: BodyTree) -> Constraint:
        """Name, number and pattern of the rows."""

    def rows(self, tree: BodyTree, k: LinkKinematics) -> tuple[dict[str, FloatArray], FloatArray]:
        """Blocks (rows, 6) per variable and limits (rows,) for the one frame in `k`."""
        blocks, limit = self.all_rows(tree, k)
        return {name: block[0] for name, block in blocks.items()}, limit

    @abstractmethod
    def all_rows(self, tree: BodyTree, k: LinkKinematics) -> tuple[dict[str, FloatArray], FloatArray]:
        """Blocks (1 or n, rows, 6) per variable and limits (rows,) for all frames in `k`."""

    @abstractmethod
    def words(self, row: int) -> str:
        """What it means that a row holds with equality."""

    def frames(self, index: IntArray) -> DynamicsConstraint:
        """The same constraint at some of the frames."""
        return self


@dataclass(frozen=True)
class ContactConstraint(DynamicsConstraint):
    """A constraint on the external wrench of one link, stated in a frame of the contact.

    Attributes
    ----------
    link : str
    R_l_s, p_l_s : ndarray
        Contact frame in the link's frame; its z axis is the inward normal.
    """

    link: str
    R_l_s: FloatArray = field(default_factory=lambda: np.eye(3))
    p_l_s: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def unit(self) -> str:
        """Unit of a row."""
        return "N"

    @abstractmethod
    def facets(self) -> FloatArray:
        """``G_s`` (rows, 6): ``G_s w_s <= h`` for the wrench in the contact's frame."""

    def limit(self) -> FloatArray:
        """H (rows,)."""
        return np.zeros(self.facets().shape[0])

    def row_pattern(self, tree: BodyTree) -> Constraint:
        """Name, number and pattern of the rows."""
        if self.link not in tree.links:
            raise InputError(f"link of {self.name}", "one of " + ", ".join(tree.links), repr(self.link))
        G = self._in_link()
        return Constraint(
            self.name,
            G.shape[0],
            (wrench_on(self.link),),
            "inequality",
            {wrench_on(self.link): G != 0.0},
            self.unit,
        )

    def all_rows(self, tree: BodyTree, k: LinkKinematics) -> tuple[dict[str, FloatArray], FloatArray]:
        """Blocks and limits; the same in every frame, as the contact moves with the link."""
        return {wrench_on(self.link): self._in_link()[None]}, self.limit()

    def _in_link(self) -> FloatArray:
        back = np.asarray(self.R_l_s, dtype=float).T
        X = np.zeros((6, 6))
        X[:3, :3] = X[3:, 3:] = back
        X[3:, :3] = -back @ skew(np.asarray(self.p_l_s, dtype=float))
        return np.asarray(self.facets() @ X)


@dataclass(frozen=True)
class UnilateralContact(ContactConstraint):
    """The surroundings push and do not pull: ``f_z >= 0``."""

    @property
    def name(self) -> str:
        """Unique within a problem."""
        return f"unilateral contact of {self.link}"

    def facets(self) -> FloatArray:
        """One row."""
        return np.array([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]])

    def words(self, row: int) -> str:
        """What it means that a row holds with equality."""
        return f"{self.link} does not press: its normal force is zero, the data alone would have it pull"


@dataclass(frozen=True)
class FrictionPyramid(ContactConstraint):
    """Tangential force within friction: ``|f_t| <= mu f_z``, as a pyramid inside the cone.

    Attributes
    ----------
    friction : float
        Coefficient mu.
    sides : int
        Sides of the pyramid; 8 lose at most 8 % of the cone.
    """

    friction: float = 0.7
    sides: int = 8

    def __post_init__(self) -> None:
        if not self.friction > 0.0 or self.sides < 3:
            raise InputError(
                f"friction of {self.link}",
                "a coefficient above zero and at least 3 sides",
                f"{self.friction}, {self.sides}",
            )

    @property
    def name(self) -> str:
        """Unique within a problem."""
        return f"friction of {self.link}"

    def facets(self) -> FloatArray:
        """One row a side."""
        angle = 2.0 * np.pi * np.arange(self.sides) / self.sides
        out = np.zeros((self.sides, 6))
        out[:, 0], out[:, 1], out[:, 2] = (
            np.cos(angle),
            np.sin(angle),
            -self.friction * np.cos(np.pi / self.sides),
        )
        return out

    def words(self, row: int) -> str:
        """What it means that a row holds with equality."""
        angle = 360.0 * row / self.sides
        side = f"towards {angle:.0f} deg from the x axis of the contact"
        return f"{self.link} is at its friction limit (coefficient {self.friction:g}) {side}"


@dataclass(frozen=True)
class CentreOfPressure(ContactConstraint):
    """The centre of pressure lies in the sole: for every edge of a convex polygon ``a' [-m_y, m_x] <= b f_z``.

    Attributes
    ----------
    corners : ndarray
        (m, 2) in the x-y plane of the contact, counter-clockwise, m.
    """

    corners: FloatArray = field(
        default_factory=lambda: np.array([[-0.06, -0.05], [0.18, -0.05], [0.18, 0.05], [-0.06, 0.05]])
    )

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners, dtype=float)
        if corners.ndim != 2 or corners.shape[1] != 2 or corners.shape[0] < 3:
            raise InputError(f"corners of {self.link}", "shape (m, 2) with m >= 3, in m", str(corners.shape))
        edges = np.roll(corners, -1, axis=0) - corners
        turn = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
        if np.any(turn <= 0.0):
            raise InputError(
                f"corners of {self.link}", "a convex polygon, counter-clockwise", f"{corners.tolist()}"
            )
        object.__setattr__(self, "corners", corners)

    @property
    def name(self) -> str:
        """Unique within a problem."""
        return f"centre of pressure of {self.link}"

    @property
    def unit(self) -> str:
        """Unit of a row."""
        return "Nm"

    def facets(self) -> FloatArray:
        """One row an edge."""
        edges = np.roll(self.corners, -1, axis=0) - self.corners
        outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        out = np.zeros((len(edges), 6))
        out[:, 2] = -np.sum(outward * self.corners, axis=1)
        out[:, 3], out[:, 4] = outward[:, 1], -outward[:, 0]
        return out

    def words(self, row: int) -> str:
        """What it means that a row holds with equality."""
        a, b = self.corners[row], self.corners[(row + 1) % len(self.corners)]
        edge = f"from ({a[0]:.3f}, {a[1]:.3f}) to ({b[0]:.3f}, {b[1]:.3f}) m"
        return f"the centre of pressure of {self.link} is on the edge {edge} of its sole"


@dataclass(frozen=True)
class TorqueLimit(DynamicsConstraint):
    """``lower <= S_j' f_j <= upper`` for the degrees of freedom of a joint.

    Attributes
    ----------
    joint : str
    lower, upper : ndarray
        (n_j,) or a number, Nm; infinite where there is none on that side for all.
    dofs : tuple of str
        Filled in from the body.
    """

    joint: str
    lower: ArrayLike
    upper: ArrayLike
    dofs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Unique within a problem."""
        return f"torque limit of {self.joint}"

    @property
    def unit(self) -> str:
        """Unit of a row."""
        return "Nm"

    def row_pattern(self, tree: BodyTree) -> Constraint:
        """Name, number and pattern of the rows: all upper limits, then all lower ones."""
        if self.joint not in tree.joints:
            raise InputError(f"joint of {self.name}", "one of " + ", ".join(tree.joints), repr(self.joint))
        j = tree.joints.index(self.joint)
        if not tree.dofs[j]:
            raise InputError(f"joint of {self.name}", "a joint with known axes", "none")
        low, high = self._limits(len(tree.dofs[j]))
        if np.any(np.isnan(low)) or np.any(np.isnan(high)) or np.any(low > high):
            raise InputError(self.name, "lower <= upper in Nm", f"{low} and {high}")
        object.__setattr__(self, "dofs", tree.dofs[j])
        S = tree.subspaces[j]
        one = np.ones((len(tree.dofs[j]), 6), dtype=bool) if S is None else S.T != 0.0
        pattern = np.vstack([one, one])
        return Constraint(
            self.name,
            pattern.shape[0],
            (wrench_of(self.joint),),
            "inequality",
            {wrench_of(self.joint): pattern},
            "Nm",
        )

    def all_rows(self, tree: BodyTree, k: LinkKinematics) -> tuple[dict[str, FloatArray], FloatArray]:
        """Blocks and limits of all frames."""
        S = k.subspaces[tree.joints.index(self.joint)]
        assert S is not None
        back = np.swapaxes(S, 1, 2)
        low, high = self._limits(back.shape[1])
        # A limit that is not there is one that no human joint reaches: an infinite one is no number for a solver.
        limit = np.minimum(np.concatenate([high, -low]), 1e6)
        return {wrench_of(self.joint): np.concatenate([back, -back], axis=1)}, limit

    def words(self, row: int) -> str:
        """What it means that a row holds with equality."""
        size = max(len(self.dofs), 1)
        low, high = self._limits(size)
        side, value = ("upper", high[row]) if row < size else ("lower", low[row - size])
        return f"the torque of {self.dofs[row % size]} is at its {side} limit of {value:g} Nm"

    def _limits(self, size: int) -> tuple[FloatArray, FloatArray]:
        low, high = np.asarray(self.lower, dtype=float), np.asarray(self.upper, dtype=float)
        try:
            return np.broadcast_to(low, (size,)), np.broadcast_to(high, (size,))
        except ValueError:
            raise InputError(
                self.name, f"{size} limits or one for all, Nm", f"shapes {low.shape} and {high.shape}"
            ) from None


def feet_on_the_floor(
    links: Sequence[str],
    friction: float = 0.7,
    corners: FloatArray | None = None,
    R_l_s: FloatArray | None = None,
    p_l_s: ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[ContactConstraint, ...]:
    """Unilateral contact, friction and centre of pressure for every link, in the same frame of their soles."""
    R, p = np.eye(3) if R_l_s is None else np.asarray(R_l_s, dtype=float), np.asarray(p_l_s, dtype=float)
    out: list[ContactConstraint] = []
    for link in links:
        pressure = CentreOfPressure(link, R, p)
        out += [
            UnilateralContact(link, R, p),
            FrictionPyramid(link, R, p, friction),
            pressure if corners is None else replace(pressure, corners=corners),
        ]
    return tuple(out)
