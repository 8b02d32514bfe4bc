"""Global optimum of a quadratic cost over SO(3), and a proof that a given rotation is it.

``min over R in SO(3) of x' Q x,  x = [vec(R); 1]``, ``vec`` stacking the **columns** of ``R`` (``x[3 j + i] = R[i, j]``); ``Q`` symmetric
(10, 10). Every residual that is linear in ``R`` gives this cost once the other linear unknowns are eliminated (mathematics, section 2.3).

On SO(3) 21 quadratic forms ``x' A_i x`` vanish: ``R'R = I`` (6), ``R R' = I`` (6), and ``r_1 x r_2 = r_3`` with its cyclic sisters (9).
With any multipliers ``l``, ``M = Q + sum l_i A_i - f E`` (``E`` has a single 1, in the last corner) gives
``x'Qx = f + x'Mx >= f + 4 min(eig M, 0)``, for ``x'x = 4``: a bound that holds whatever the multipliers are. The best one is a
semidefinite program (Shor's relaxation).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from factorgrasp import lie
from factorgrasp.errors import InputError, SolverError
from factorgrasp.typing import FloatArray

# Where the rotation is the only optimum 0 to 7 centring steps find the multipliers (300 instances); beside a flat direction it takes
# more than is worth while.
_MOST_CENTRING_STEPS = 12
# Rounding of a cost whose entries largely cancel on SO(3), in units of eps times the largest entry of Q.
_ROUNDING = 64.0 * np.finfo(np.float64).eps
# |x|^2 of [vec(R); 1] for every rotation.
_SQUARED_NORM = 4.0
_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class RotationCertificate:
    """What the multipliers prove about a rotation.

    Attributes
    ----------
    certified : bool
        No rotation costs less, up to the tolerance. False proves nothing: the multipliers may not have been found, or do not exist.
    lower_bound : float
        No rotation costs less than this.
    gap : float
        Cost of the rotation minus `lower_bound` (at least 0).
    smallest_eigenvalue : float
        Of ``M`` orthogonal to ``x``, in units of the cost; positive: the optimum is unique.
    """

    certified: bool
    lower_bound: float
    gap: float
    smallest_eigenvalue: float


class RotationSolution(NamedTuple):
    """What :func:`solve_rotation_sdp` returns."""

    rotation: FloatArray
    """(3, 3)."""
    gap: float
    """Cost of the rotation minus a proven lower bound."""
    tight: bool
    """Whether the gap is zero up to the tolerance, so that the rotation is a global optimum."""


class _Constants(NamedTuple):
    """Everything that does not depend on the data. The constraints look the same from every rotation, so it is written at ``R = I``."""

    canonical: FloatArray  # (100, 100): vec(Q) to the part of Q that varies over SO(3)
    reduce: FloatArray  # (100, 100): vec(Q) to U' M U with stationary multipliers of least Frobenius norm
    free: FloatArray  # (14, 9, 9): what the remaining multipliers add to the lower right block of U' M U, orthonormal
    forms: FloatArray  # (20, 10, 10): orthonormal basis of the constraint matrices
    identity: FloatArray  # (10,): x of R = I


def constraint_matrices() -> FloatArray:
    """The 21 symmetric matrices ``A_i`` (21, 10, 10) with ``x' A_i x = 0`` on SO(3), one of them dependent on the others.

    In this order: columns of unit length and orthogonal (11, 12, 13, 22, 23, 33), rows likewise, ``r_1 x r_2 - r_3``, ``r_2 x r_3 - r_1``,
    ``r_3 x r_1 - r_2`` (three components each, ``r_j`` the columns).
    """
    matrices = []

    def add(*entries: tuple[int, int, float]) -> None:
        matrix = np.zeros((10, 10))
        for row, column, value in entries:
            matrix[row, column] += 0.5 * value
            matrix[column, row] += 0.5 * value
        matrices.append(matrix)

    cyclic = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    place = np.arange(9).reshape(3, 3).T  # place[i, j] of R[i, j] in x
    for rows in (place.T, place):
        for a in range(3):
            for b in range(a, 3):
                unit = [(9, 9, -1.0)] if a == b else []
                add(*((rows[a, k], rows[b, k], 1.0) for k in range(3)), *unit)
    for a, b, c in cyclic:
        for i, j, k in cyclic:
            add((place[j, a], place[k, b], 1.0), (place[k, a], place[j, b], -1.0), (place[i, c], 9, -1.0))
    return np.array(matrices)


def vectorized(R: npt.ArrayLike) -> FloatArray:
    """``x = [vec(R); 1]``, columns of ``R`` stacked: ``(..., 3, 3)`` to ``(..., 10)``."""
    R = np.asarray(R, dtype=np.float64)
    out = np.ones((*R.shape[:-2], 10))
    out[..., :9] = np.swapaxes(R, -1, -2).reshape(*R.shape[:-2], 9)
    return out


def rotation_cost(Q: npt.ArrayLike, R: npt.ArrayLike) -> FloatArray:
    """``x' Q x`` of one rotation or of many, ``(..., 3, 3)`` to ``(...)``."""
    x = vectorized(R)
    out: FloatArray = np.einsum("...i,...i->...", x @ np.asarray(Q, dtype=np.float64), x)
    return out


def certify_rotation(Q: npt.ArrayLike, R: npt.ArrayLike, tolerance: float = 1e-8) -> RotationCertificate:
    """Try to prove that a rotation is the global optimum, without an SDP (0.1 to 0.4 ms).

    Parameters
    ----------
    Q : array_like, shape (10, 10)
        Symmetric; see the module for the order of ``x``.
    R : array_like, shape (3, 3)
        A converged local optimum.
    tolerance : float
        Largest gap, relative to how much the cost varies over SO(3) (the Frobenius norm of the part of ``Q`` that is not constant there).

    Returns
    -------
    RotationCertificate
        Its bound holds in any case.

    Notes
    -----
    Stationarity ``M x = 0`` fixes 6 combinations of the multipliers by least squares. The 14 others start where ``M`` has the least
    Frobenius norm (its weighted trace is given, so this draws the eigenvalues together). When that ``M`` is not positive semidefinite,
    Newton steps on ``log det(M + s I)`` with a shrinking ``s`` raise its smallest eigenvalue. They stop early when the dual of that
    problem shows that no multipliers will do.
    """
    Q, R = _checked(Q, "Q"), _checked_rotation(R)
    constants = _constants()
    turned = _turn(Q, R)
    cost = float(constants.identity @ turned @ constants.identity)
    varying = constants.canonical @ turned.ravel()
    limit = tolerance * float(np.linalg.norm(varying)) + _ROUNDING * float(np.abs(Q).max())
    M = (constants.reduce @ varying).reshape(10, 10)
    block = M[1:, 1:]
    smallest = lowest = -np.inf
    margin = 0.2
    for step in range(_MOST_CENTRING_STEPS + 1):
        values, vectors = np.linalg.eigh(block)
        if values[0] > smallest:
            smallest = float(values[0])
            M[1:, 1:] = block
        if _SQUARED_NORM * values[0] >= -limit:
            lowest = float(np.linalg.eigvalsh(M)[0])
            if _SQUARED_NORM * lowest >= -limit:
                break
        if step == _MOST_CENTRING_STEPS:
            break
        centred = _centre(values, vectors, constants.free, margin, limit / _SQUARED_NORM)
        if centred is None:
            break
        change, decrement = centred
        # The barrier moves on only as fast as the multipliers follow it.
        margin *= 0.1 if decrement < 0.5 else 0.5 if decrement < 0.8 else 1.0
        block = block + change
    if not np.isfinite(lowest):
        lowest = float(np.linalg.eigvalsh(M)[0])
    gap = _SQUARED_NORM * max(-lowest, 0.0)
    return RotationCertificate(bool(gap <= limit), cost - gap, gap, smallest)


def refine_rotation(Q: npt.ArrayLike, R: npt.ArrayLike) -> FloatArray:
    """Nearest-by local optimum (3, 3) of ``x' Q x`` by Newton's method on SO(3), from `R` (3, 3); never a higher cost than at `R`."""
    start = _checked_rotation(R)[None]
    # Without what is constant on SO(3), differences of the cost keep their digits.
    varying = (_constants().canonical @ _checked(Q, "Q").ravel()).reshape(10, 10)
    return np.asarray(_descend(varying, start)[0])


def solve_rotation_sdp(Q: npt.ArrayLike, tolerance: float = 1e-8) -> RotationSolution:
    """Global optimum of ``x' Q x`` over SO(3) by Shor's relaxation (needs clarabel), rounding and Newton steps.

    Parameters
    ----------
    Q : array_like, shape (10, 10)
    tolerance : float
        As in :func:`certify_rotation`.

    Returns
    -------
    RotationSolution
        Unpacks as ``R, gap, tight``. Without clarabel: the best of local searches from the 24 rotations of the cube, with whatever
        :func:`certify_rotation` proves about it; where that proves nothing `tight` is False.
    """
    Q = _checked(Q, "Q")
    varying = (_constants().canonical @ Q.ravel()).reshape(10, 10)
    scale = float(np.linalg.norm(varying))
    if scale <= _ROUNDING * float(np.abs(Q).max()):
        return RotationSolution(np.eye(3), 0.0, True)
    varying /= scale
    bound = -np.inf
    starts = cube_rotations()
    if find_spec("clarabel") is not None:
        bound, starts = _relax(varying)
    candidates = _descend(varying, starts)
    best = candidates[int(np.argmin(rotation_cost(varying, candidates)))]
    certificate = certify_rotation(varying, best, tolerance)
    gap = max(float(rotation_cost(varying, best)) - max(bound, certificate.lower_bound), 0.0)
    tight = gap <= tolerance + _ROUNDING * float(np.abs(Q).max()) / scale
    return RotationSolution(best, gap * scale, bool(tight))


@cache
def cube_rotations() -> FloatArray:
    """The 24 rotations of the cube, (24, 3, 3): no rotation is farther than 63 deg from the nearest of them."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0.0:
                out.append(matrix)
    return np.array(out)


# ------------------------------------------------------------------------------------------ internals


@cache
def _constants() -> _Constants:
    matrices = constraint_matrices()
    x = vectorized(np.eye(3))
    corner = np.zeros((10, 10))
    corner[9, 9] = 1.0
    forms = _row_basis(matrices.reshape(21, 100))
    constant = _row_basis(np.vstack([forms, corner.reshape(1, 100)]))
    canonical = np.eye(100) - constant.T @ constant

    gradients = forms.reshape(20, 10, 10) @ x
    _, singular, right = np.linalg.svd(gradients.T)
    rank = int(np.sum(singular > 1e-9))
    U = np.linalg.svd(x[None])[2].T
    U[:, 0] = 0.5 * x
    null = (right[rank:] @ forms).reshape(-1, 10, 10)
    free = np.einsum("ia,kij,jb->kab", U[:, 1:], null, U[:, 1:])

    # vec(Q) -> vec(Q - f E) -> add stationary multipliers -> U' M U -> remove what the free multipliers can remove.
    level = np.eye(100) - np.outer(corner, np.outer(x, x))
    apply_x = np.kron(np.eye(10), x[None])
    stationary = (np.eye(100) - forms.T @ np.linalg.pinv(gradients.T) @ apply_x) @ level
    turned = np.kron(U.T, U.T) @ stationary
    padded = np.zeros((free.shape[0], 10, 10))
    padded[:, 1:, 1:] = free
    rows = padded.reshape(free.shape[0], 100)
    reduce = turned - rows.T @ (rows @ turned)
    return _Constants(canonical, reduce, free, forms.reshape(20, 10, 10), x)


def _row_basis(rows: FloatArray) -> FloatArray:
    _, singular, right = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(right[singular > 1e-9])


def _turn(Q: FloatArray, R: FloatArray) -> FloatArray:
    """The same cost written in ``R' R_new``: `R` becomes the identity."""
    turn = np.zeros((10, 10))
    turn[0:3, 0:3] = turn[3:6, 3:6] = turn[6:9, 6:9] = R
    turn[9, 9] = 1.0
    out: FloatArray = turn.T @ Q @ turn
    return out


def _centre(
    values: FloatArray, vectors: FloatArray, free: FloatArray, margin: float, slack: float
) -> tuple[FloatArray, float] | None:
    """One Newton step on ``log det(S + s I)`` over the free multipliers; None when no multipliers make ``S`` better than ``-slack``.

    Returns the change of ``S`` (9, 9) and the Newton decrement: how far from the centre it started.

    Parameters
    ----------
    values, vectors : ndarray
        Eigenvalues (9,), ascending, and eigenvectors (9, 9) of ``S``.
    free : ndarray, shape (14, 9, 9)
    margin : float
        ``s`` makes the smallest eigenvalue this part of the distance from there to their mean.
    slack : float
    """
    shifted = values - values[0] + margin * (values.mean() - values[0])
    if not shifted[0] > 0.0:
        return None
    scaled = vectors / np.sqrt(shifted)
    changes = scaled.T @ free @ scaled
    rows = changes.reshape(free.shape[0], -1)
    gradient = np.trace(changes, axis1=1, axis2=2)
    try:
        step = np.linalg.solve(rows @ rows.T, gradient)
    except np.linalg.LinAlgError:
        return None
    direction = (step @ rows).reshape(changes.shape[1:])
    slopes = np.linalg.eigvalsh(direction)
    if slopes[-1] <= 1.0:
        # W = scaled (I - direction) scaled' is positive semidefinite and orthogonal to every free matrix, so tr(W S) is
        # the same for all multipliers; where it is negative none of them makes S positive semidefinite.
        weights = (1.0 - np.diag(direction)) / shifted
        if weights @ values < -slack * weights.sum():
            return None
    # Exact line search: log det along the step is sum log(1 + a slope), concave.
    decrement = float(np.sqrt(max(float(gradient @ step), 0.0)))
    length = 1.0 / (1.0 + decrement)
    furthest = -0.99 / slopes[0] if slopes[0] < 0.0 else np.inf
    for _ in range(4):
        rates = slopes / (1.0 + length * slopes)
        length = min(max(length + rates.sum() / (rates @ rates), 0.0), furthest)
    change = ((length * step) @ free.reshape(free.shape[0], -1)).reshape(changes.shape[1:])
    return change, decrement


def _descend(Q: FloatArray, R: FloatArray, steps: int = 60) -> FloatArray:
    """Newton's method from every rotation of `R` (m, 3, 3) at once; negative curvature is followed downhill."""
    R = R.copy()
    cost = rotation_cost(Q, R)
    scale = max(float(np.abs(Q).max()), np.finfo(np.float64).tiny)
    # R S(e_k), columns stacked, is linear in R: (10, 3) for each rotation.
    generators = lie.skew(np.eye(3))
    active = np.arange(len(R))
    reach = np.ones(len(R))
    for _ in range(steps):
        here = R[active]
        slope = (vectorized(here) @ Q)[:, :9].reshape(-1, 3, 3).swapaxes(1, 2)
        N = here.swapaxes(1, 2) @ slope
        gradient = 4.0 * lie.vee(N)
        J = np.einsum("mij,kjl->mlik", here, generators).reshape(-1, 9, 3)
        curvature = N + N.swapaxes(1, 2) - 2.0 * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        hessian = 2.0 * J.swapaxes(1, 2) @ Q[:9, :9] @ J + curvature
        values, vectors = np.linalg.eigh(hessian)
        along = np.einsum("mij,mi->mj", vectors, gradient)
        floor = np.maximum(np.abs(values), 1e-12 * scale)
        move = -np.einsum("mij,mj->mi", vectors, along / floor)
        length = np.linalg.norm(move, axis=1)
        move *= np.minimum(1.0, reach[active] / np.maximum(length, 1e-300))[:, None]
        tried = here @ lie.so3_exp(move)
        new = rotation_cost(Q, tried)
        better = new <= cost[active]
        R[active[better]] = tried[better]
        cost[active[better]] = new[better]
        reach[active] = np.where(
            better, np.minimum(2.0 * reach[active], 1.0), 0.25 * np.minimum(length, reach[active])
        )
        # A step this small is at the rounding of the cost, accepted or not.
        active = active[(length > 1e-9) & (reach[active] > 1e-12)]
        if active.size == 0:
            break
    return lie.project_to_so3(R)


def _relax(Q: FloatArray) -> tuple[float, FloatArray]:
    """Proven lower bound of ``x'Qx`` from the SDP's multipliers, and the rotations (k, 3, 3) that its moment matrix suggests."""
    import clarabel
    import scipy.sparse as sp

    forms = _constants().forms
    # Upper triangle, column by column, off-diagonal entries times sqrt(2): clarabel's vector of a symmetric matrix.
    columns, rows = np.tril_indices(10)
    weight = np.where(rows == columns, 1.0, np.sqrt(2.0))
    corner = (rows == 9) & (columns == 9)
    # max f  s.t.  Q - f E + sum l_i A_i positive semidefinite; unknowns [f, l].
    A = np.column_stack([corner.astype(np.float64), -(forms[:, rows, columns] * weight).T])
    target = np.zeros(A.shape[1])
    target[0] = -1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
    settings.max_threads = 1
    solver = clarabel.DefaultSolver(
        sp.csc_matrix((A.shape[1], A.shape[1])),
        target,
        sp.csc_matrix(A),
        Q[rows, columns] * weight,
        [clarabel.PSDTriangleConeT(10)],
        settings,
    )
    solution = solver.solve()
    unknowns = np.asarray(solution.x, dtype=np.float64)
    moments = np.asarray(solution.z, dtype=np.float64) / weight
    if not (np.isfinite(unknowns).all() and np.isfinite(moments).all()):
        raise SolverError(f"clarabel failed on the relaxation of a rotation: {solution.status}")
    M = Q + np.tensordot(unknowns[1:], forms, 1)
    M[9, 9] -= unknowns[0]
    bound = float(unknowns[0] + _SQUARED_NORM * min(float(np.linalg.eigvalsh(M)[0]), 0.0))
    X = np.zeros((10, 10))
    X[rows, columns] = X[columns, rows] = moments
    # With one optimum X = x x', and its last column is x; with several, each eigenvector is a mixture of them.
    vectors = np.linalg.eigh(X)[1][:, -3:]
    vectors = vectors * np.where(vectors[9] < 0.0, -1.0, 1.0)
    suggestions = np.column_stack([X[:, 9], vectors])[:9].T.reshape(-1, 3, 3).swapaxes(1, 2)
    return bound, lie.project_to_so3(suggestions)


def _checked(Q: npt.ArrayLike, field: str) -> FloatArray:
    matrix = np.asarray(Q, dtype=np.float64)
    if matrix.shape != (10, 10):
        raise InputError(field, "shape (10, 10)", f"shape {matrix.shape}")
    largest = float(np.abs(matrix).max())
    if not np.isfinite(largest):
        raise InputError(field, "finite numbers", "NaN or infinity")
    difference = float(np.abs(matrix - matrix.T).max())
    if difference > 1e-9 * largest:
        raise InputError(
            field, "a symmetric matrix", f"entries that differ by {difference:.3g} from their mirror images"
        )
    out: FloatArray = 0.5 * (matrix + matrix.T)
    return out


def _checked_rotation(R: npt.ArrayLike) -> FloatArray:
    matrix = np.asarray(R, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise InputError("R", "a rotation, shape (3, 3)", f"shape {matrix.shape}")
    defect = matrix.T @ matrix - _IDENTITY
    error = float(np.abs(defect).max())
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not error <= 1e-6 or determinant < 0.0:
        raise InputError(
            "R",
            "a rotation: orthonormal, determinant +1",
            f"|R'R - I| up to {error:.3g}, determinant {determinant:.6g}",
        )
    # One step towards the nearest rotation squares the error, at a tenth of the price of singular values.
    out: FloatArray = matrix - 0.5 * matrix @ defect
    return out
