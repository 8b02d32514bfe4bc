"""Generalised forces of coordinates that joints do not turn about a fixed axis by: a knee that slides while it bends.

The power of a joint's wrench ``f`` (parent on child) in the motion of the child relative to the parent is ``f'
v_rel``; where that motion has one
coordinate, ``v_rel = s(q) dq`` and the coordinate's generalised force is

    ``tau = s' f = w . M + (dT/dq) . F``

with w the axis in the child's frame, M the moment about the child's origin and dT/dq how its origin slides in the
parent, both per unit of q.
``w . M`` alone is off by what the force does along the slide. OpenSim's inverse dynamics reports this sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
from factorgrasp.problems.link_motion import LinkMotion
from factorgrasp.typing import FloatArray

DEGREE = 6
"""Of the polynomials in q that the directions of motion are taken to be."""
FEWEST = 20


@dataclass(frozen=True)
class Coordinate:
    """How one coordinate moves the child of a joint.

    Attributes
    ----------
    name, joint : str
    direction : ndarray
        (n, 6) ``s = v_rel / dq`` ``[linear; angular]`` in the child's frame, at its origin: m (or 1 for a sliding
        coordinate) and rad per unit of q.
    misfit : float
        Largest part of the relative velocity (m/s, rad/s, root mean square) that the coordinate does not explain:
        large where the joint has more
        coordinates than this one.
    """

    name: str
    joint: str
    direction: FloatArray
    misfit: float = 0.0


@dataclass(frozen=True)
class GeneralisedForce:
    """A coordinate's force over n frames.

    Attributes
    ----------
    name : str
    value, sd : ndarray
        (n,) Nm for an angle, N for a length; sd NaN where the estimate has no covariance.
    turning, sliding : ndarray
        (n,) the two terms of it: of the moment about the child's origin, and of the force.
    """

    name: str
    value: FloatArray
    sd: FloatArray
    turning: FloatArray
    sliding: FloatArray


def coordinate_from_motion(
    motion: LinkMotion, joint: str, q: ArrayLike, qd: ArrayLike, name: str = "", degree: int = DEGREE
) -> Coordinate:
    """Direction of a joint's single coordinate, from the motion of its links.

    The relative velocity of the two links is fitted by ``s(q) dq`` with polynomials s of the coordinate, all frames
    together, so that frames in which
    the joint hardly moves do no harm.

    Parameters
    ----------
    motion : LinkMotion
    joint : str
    q, qd : (n,) array_like
        The coordinate (rad or m) and its rate.
    name : str
        Of the coordinate; the joint's by default.
    degree : int
        Of the polynomials.

    Raises
    ------
    InputError
        When the sizes differ, or the joint hardly moves.
    """
    angle, rate = np.asarray(q, dtype=float), np.asarray(qd, dtype=float)
    for label, value in (("q", angle), ("qd", rate)):
        if value.shape != (len(motion),):
            raise InputError(f"{label} of {name or joint}", f"shape ({len(motion)},)", str(value.shape))
    j = motion.joint(joint)
    v = motion.spatial_velocity
    up, down = int(motion.parents[j]), int(motion.children[j])
    relative = v[:, down] - (motion.joint_transform[:, j] @ v[:, up, :, None])[..., 0]
    good = np.isfinite(relative).all(axis=1) & np.isfinite(angle) & np.isfinite(rate)
    span = float(np.ptp(angle[good])) if good.any() else 0.0
    if good.sum() < FEWEST or span < 1e-3:
        raise InputError(
            f"motion of {joint}", f"at least {FEWEST} frames in which its coordinate moves",
            f"{int(good.sum())} frames over a range of {span:.2g}",
        )  # fmt: skip
    x = 2.0 * (angle - angle[good].min()) / span - 1.0
    basis = np.polynomial.chebyshev.chebvander(x, degree)
    weights, *_ = np.linalg.lstsq(basis[good] * rate[good, None], relative[good], rcond=1e-9)
    left = relative[good] - (basis[good] * rate[good, None]) @ weights
    misfit = float(np.sqrt(np.mean(left**2, axis=0)).max())
    return Coordinate(name or joint, joint, basis @ weights, misfit)


def generalised_force(estimate: HumanDynamicsEstimate, coordinate: Coordinate) -> GeneralisedForce:
    """``s' f`` of a joint's estimated wrench, with its standard deviation from those of the wrench's components together.

    Raises
    ------
    InputError
        When the joint is not one of the estimate's, or the frames differ.
    """
    if coordinate.joint not in estimate.joint_names:
        raise InputError("joint", "one of " + ", ".join(estimate.joint_names), repr(coordinate.joint))
    s, j = coordinate.direction, estimate.joint_names.index(coordinate.joint)
    if s.shape != (len(estimate), 6):
        raise InputError(f"direction of {coordinate.name}", f"shape ({len(estimate)}, 6)", str(s.shape))
    f = estimate.joint_wrench[:, j]
    sliding, turning = np.sum(s[:, :3] * f[:, :3], axis=1), np.sum(s[:, 3:] * f[:, 3:], axis=1)
    variance = np.einsum("ni,nij,nj->n", s, estimate.joint_wrench_covariance[:, j], s)
    return GeneralisedForce(
        coordinate.name, turning + sliding, np.sqrt(np.maximum(variance, 0.0)), turning, sliding
    )
