"""A motion in a basis as a nonlinear program: an integral to minimise, integrals over windows to keep, limits at instants.

Unknowns are the coefficients C (m, functions) of m coordinates ``x(t) = offset(t) + C b(t)``, and the Cholesky factors of the
excitation beyond what is asked for:

    minimise   1/T integral s_0(z, p) dt
    subject to Psi(integral over window w of s(z, p) dt) = I + L_w L_w'      (or >= 1, entry by entry)
               low <= h(z, p) <= high at chosen instants,  low <= a derivative of a coordinate <= high at chosen instants,
               rest at the ends

with ``z = [x, dx/dt, d2x/dt2]``. The first is the persistent-excitation condition; its Cholesky factor as an unknown keeps it smooth
and exact.
All derivatives are exact and are assembled from those of one instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from factorgrasp.models.motion_basis import MotionBasis
from factorgrasp.problems.excitation_node import NodeFunction
from factorgrasp.typing import FloatArray, IntArray

Given = Callable[[FloatArray], FloatArray]
"""Times (n,) to arrays."""


@dataclass(frozen=True)
class CoordinateLimit:
    """``lower <= d^order x_coordinate / dt^order (time) <= upper``, the row divided by `scale`."""

    coordinate: int
    order: int
    time: float
    lower: float
    upper: float
    scale: float
    words: str


@dataclass(frozen=True)
class PathLimit:
    """``lower <= h_index(z, p)(time) <= upper``, the row divided by `scale`."""

    index: int
    time: float
    lower: float
    upper: float
    scale: float
    words: str


@dataclass(frozen=True, eq=False)
class Motion:
    """What all programs about one motion share.

    Attributes
    ----------
    basis : MotionBasis
    coordinates : int
    offset : callable
        Times (n,) to (4, coordinates, n): the motion of zero coefficients, and its derivatives.
    given : callable
        Times (n,) to (p, n): the numbers p of the instants.
    """

    basis: MotionBasis
    coordinates: int
    offset: Given
    given: Given

    def at(self, C: FloatArray, t: FloatArray, orders: int = 3) -> FloatArray:
        """(orders, coordinates, n): values and derivatives."""
        base = self.offset(t)
        return np.stack([base[d] + C @ self.basis.values(t, d) for d in range(orders)])

    @property
    def ends(self) -> tuple[float, ...]:
        """Times at which conditions hold both ends: a periodic basis needs only one."""
        basis = self.basis
        gap = basis.values(np.array([basis.duration]), 0) - basis.values(np.zeros(1), 0)
        return (0.0,) if np.max(np.abs(gap)) < 1e-9 else (0.0, basis.duration)


@dataclass(frozen=True, eq=False)
class Windows:
    """Excitation that is asked for.

    Attributes
    ----------
    weights : ndarray, shape (w, n)
        Quadrature weights of every window at the nodes, s.
    condition : NodeFunction
        ``Psi`` from the integrals (integrands,) of a window, and no p: what has to reach one.
    matrix : bool
        Whether Psi is the upper triangle (row by row) of a matrix that has to reach the identity, or numbers that each have to reach one.
    words : tuple of str
        One a window.
    """

    weights: FloatArray
    condition: NodeFunction
    matrix: bool
    words: tuple[str, ...]


def triangle(size: int) -> list[tuple[int, int]]:
    """Row and column of the entries of an upper triangle, row by row."""
    return [(i, j) for i in range(size) for j in range(i, size)]


def _cholesky_function(size: int) -> NodeFunction:
    """``L -> triangle of I + L L'``, L lower with its entries row by row of L'."""
    import casadi as ca

    where = triangle(size)
    y = ca.SX.sym("y", len(where))
    L = ca.SX(size, size)
    for k, (i, j) in enumerate(where):
        L[j, i] = y[k]
    S = L @ L.T + ca.DM.eye(size)
    return NodeFunction("cholesky", y, ca.SX.sym("p", 0), ca.vertcat(*[S[i, j] for i, j in where]))


class TrajectoryProgram:
    """A :class:`factorgrasp.nonlinear_program.NonlinearProgram`; see the file.

    Parameters
    ----------
    motion : Motion
    t : (n,) ndarray
        Nodes of the integrals, s.
    integrand : NodeFunction
        Its first output is what the objective integrates, with `weights` (n,).
    weights : (n,) ndarray
    windows : Windows or None
    limits : sequence of CoordinateLimit
    path : NodeFunction or None
    path_limits : sequence of PathLimit
    fixed : sequence of (time, order, target)
        Conditions ``C b^(order)(time) = target`` (coordinates,).
    start : (coordinates, functions) ndarray
        Coefficients.
    reach : float
        Bound of every coefficient: none of a motion that stays within half of it is larger, and no iterate can run away.
    """

    def __init__(
        self,
        motion: Motion,
        t: FloatArray,
        integrand: NodeFunction,
        weights: FloatArray,
        windows: Windows | None,
        limits: Sequence[CoordinateLimit] = (),
        path: NodeFunction | None = None,
        path_limits: Sequence[PathLimit] = (),
        fixed: Sequence[tuple[float, int, FloatArray]] = (),
        start: FloatArray | None = None,
        reach: float = np.inf,
    ) -> None:
        self.motion, self.t, self._s, self._weights, self.windows = motion, t, integrand, weights, windows
        m, nb = motion.coordinates, motion.basis.size
        self._m, self._nb, self._nc = m, nb, m * nb
        self._B = np.stack([motion.basis.values(t, d) for d in range(3)])
        self._offset, self._p = motion.offset(t)[:3], motion.given(t)
        self._path = path
        self._aux: NodeFunction | None = None
        self._per_window, self._count = 0, 0
        if windows is not None:
            self._count = windows.weights.shape[0]
            self._rows_per_window = windows.condition.size_out
            if windows.matrix:
                size = round((np.sqrt(8 * windows.condition.size_out + 1) - 1) / 2)
                self._aux = _cholesky_function(size)
                self._per_window = windows.condition.size_out
        self._ny = self._per_window * self._count
        self.size = self._nc + self._ny
        self.limits, self.path_limits = tuple(limits), tuple(path_limits)
        self._linear(fixed)
        self._instants()
        self._bounds(reach)
        self._patterns()
        self._known: tuple[bytes, dict[str, FloatArray]] = (b"", {})
        self.start = self.point(np.zeros((m, nb)) if start is None else start)

    # ---- construction ---------------------------------------------------------------------------------------------

    def _linear(self, fixed: Sequence[tuple[float, int, FloatArray]]) -> None:
        """Rows that are linear in the coefficients."""
        nb = self._nb
        rows: list[int] = []
        columns: list[int] = []
        data: list[float] = []
        low: list[float] = []
        high: list[float] = []
        words: list[str] = []

        def add(coordinate: int, time: float, order: int, scale: float) -> None:
            values = self.motion.basis.values(np.array([time]), order)[:, 0] / scale
            rows.extend([len(low)] * nb)
            columns.extend(range(coordinate * nb, (coordinate + 1) * nb))
            data.extend(values)

        for time, order, target in fixed:
            for j in range(self._m):
                size = float(np.max(np.abs(self.motion.basis.values(np.array([time]), order))))
                scale = size if size > 0.0 else 1.0
                add(j, time, order, scale)
                low.append(target[j] / scale)
                high.append(target[j] / scale)
                words.append("rest at the ends")
        for one in self.limits:
            base = self.motion.offset(np.array([one.time]))[one.order, one.coordinate, 0]
            add(one.coordinate, one.time, one.order, one.scale)
            low.append((one.lower - base) / one.scale)
            high.append((one.upper - base) / one.scale)
            words.append(one.words)
        shape = (len(low), self._nc)
        self._A = sp.csr_array((data, (rows, columns)), shape=shape) if low else sp.csr_array(shape)
        self._A_low, self._A_high, self._A_words = np.array(low), np.array(high), words

    def _instants(self) -> None:
        times = sorted({one.time for one in self.path_limits})
        self._path_t = np.array(times)
        self._path_B = np.stack([self.motion.basis.values(self._path_t, d) for d in range(3)])
        self._path_offset, self._path_p = (
            self.motion.offset(self._path_t)[:3],
            self.motion.given(self._path_t),
        )
        place = {time: k for k, time in enumerate(times)}
        self._path_k = np.array([place[one.time] for one in self.path_limits], dtype=int)
        self._path_i = np.array([one.index for one in self.path_limits], dtype=int)
        self._path_scale = np.array([one.scale for one in self.path_limits])

    def _bounds(self, reach: float) -> None:
        self.lower, self.upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        self.lower[: self._nc], self.upper[: self._nc] = -reach, reach
        window_rows = 0 if self.windows is None else self._count * self._rows_per_window
        matrix = self.windows is not None and self.windows.matrix
        path_low = np.array([one.lower / one.scale for one in self.path_limits])
        path_high = np.array([one.upper / one.scale for one in self.path_limits])
        self.row_lower = np.concatenate([self._A_low, np.full(window_rows, 0.0 if matrix else 1.0), path_low])
        self.row_upper = np.concatenate(
            [self._A_high, np.zeros(window_rows) if matrix else np.full(window_rows, np.inf), path_high]
        )

    def _patterns(self) -> None:
        nc = self._nc
        rows, columns = [], []
        for w in range(self._count):
            for i in range(self._rows_per_window):
                row = w * self._rows_per_window + i
                first = nc + w * self._per_window
                chosen = [*range(nc), *range(first, first + self._per_window)]
                rows += [row] * len(chosen)
                columns += chosen
        self._window_at = (np.array(rows, dtype=int), np.array(columns, dtype=int))
        A = self._A.tocoo()
        n_a, n_w, n_p = (
            A.shape[0],
            self._count * (self._rows_per_window if self.windows else 0),
            len(self.path_limits),
        )
        path_rows = np.repeat(np.arange(n_p), nc) + n_a + n_w
        path_columns = np.tile(np.arange(nc), n_p)
        rows_all = np.concatenate([A.coords[0], self._window_at[0] + n_a, path_rows]).astype(int)
        columns_all = np.concatenate([A.coords[1], self._window_at[1], path_columns]).astype(int)
        self._J_order, self._J = _fixed_pattern(rows_all, columns_all, (n_a + n_w + n_p, self.size))
        self._A_data = A.data
        one, other = np.meshgrid(np.arange(nc), np.arange(nc), indexing="ij")
        h_rows, h_columns = [one.ravel()], [other.ravel()]
        for w in range(self._count if self._aux is not None else 0):
            block = np.array([*range(nc + w * self._per_window, nc + (w + 1) * self._per_window)])
            one, other = np.meshgrid(block, block, indexing="ij")
            h_rows.append(one.ravel())
            h_columns.append(other.ravel())
        self._H_order, self._H = _fixed_pattern(np.concatenate(h_rows), np.concatenate(h_columns), (self.size, self.size))  # fmt: skip

    # ---- the program ----------------------------------------------------------------------------------------------

    def coefficients(self, x: FloatArray) -> FloatArray:
        """C (coordinates, functions) of a point."""
        return x[: self._nc].reshape(self._m, self._nb)

    def point(self, C: FloatArray) -> FloatArray:
        """Unknowns of a motion, with Cholesky factors that fit it as well as they can."""
        x = np.zeros(self.size)
        x[: self._nc] = C.ravel()
        if self._aux is not None:
            size = round((np.sqrt(8 * self._per_window + 1) - 1) / 2)
            where = triangle(size)
            for w, value in enumerate(self._condition(x)):
                G = np.zeros((size, size))
                for k, (i, j) in enumerate(where):
                    G[i, j] = G[j, i] = value[k]
                d, V = np.linalg.eigh(G - np.eye(size))
                L = np.linalg.cholesky((V * np.maximum(d, 1e-3)) @ V.T)
                first = self._nc + w * self._per_window
                x[first : first + self._per_window] = [L[j, i] for i, j in where]
        return x

    def excitation(self, x: FloatArray) -> FloatArray:
        """(windows, entries) of Psi."""
        return self._condition(x)

    def objective(self, x: FloatArray) -> float:
        return float(self._weights @ self._values(x)[:, 0])

    def gradient(self, x: FloatArray) -> FloatArray:
        out = np.zeros(self.size)
        J = self._jacobians(x)[:, 0].reshape(-1, 3, self._m)
        out[: self._nc] = np.einsum("k,kdj,dbk->jb", self._weights, J, self._B, optimize=True).ravel()
        return out

    def rows(self, x: FloatArray) -> FloatArray:
        parts = [self._A @ x[: self._nc]]
        if self.windows is not None:
            psi = self._condition(x)
            if self._aux is not None:
                psi = psi - self._aux.values(self._factors(x), np.empty((0, self._count)))
            parts.append(psi.ravel())
        if self.path_limits:
            h = self._path_values(x)
            parts.append(h[self._path_k, self._path_i] / self._path_scale)
        return np.concatenate(parts)

    def jacobian(self, x: FloatArray) -> sp.csc_array:
        parts = [self._A_data]
        if self.windows is not None:
            outer = self.windows.condition.jacobians(self._integrals(x).T, np.empty((0, self._count)))
            S = self._integral_jacobian(x)
            dpsi = np.einsum("wri,wic->wrc", outer, S, optimize=True)
            if self._aux is not None:
                of_y = -self._aux.jacobians(self._factors(x), np.empty((0, self._count)))
            else:
                of_y = np.empty((self._count, self._rows_per_window, 0))
            parts.append(np.concatenate([dpsi, of_y], axis=2).ravel())
        if self.path_limits:
            J = self._path_jacobians(x)[self._path_k, self._path_i].reshape(-1, 3, self._m)
            B = self._path_B[:, :, self._path_k]
            parts.append(
                (np.einsum("kdj,dbk->kjb", J, B, optimize=True) / self._path_scale[:, None, None]).ravel()
            )
        data = np.bincount(self._J_order, weights=np.concatenate(parts), minlength=self._J.nnz)
        return sp.csc_array((data, self._J.indices, self._J.indptr), self._J.shape)

    def hessian(self, x: FloatArray, factor: float, multipliers: FloatArray) -> sp.csc_array:
        load = np.zeros((self._s.size_out, self.t.size))
        load[0] = factor * self._weights
        n_a = self._A.shape[0]
        extra = np.zeros((self._nc, self._nc))
        blocks: list[FloatArray] = []
        if self.windows is not None:
            n_w = self._count * self._rows_per_window
            y = multipliers[n_a : n_a + n_w].reshape(self._count, self._rows_per_window)
            integrals, none = self._integrals(x).T, np.empty((0, self._count))
            outer = self.windows.condition.jacobians(integrals, none)
            mu = np.einsum("wr,wri->wi", y, outer)
            load += mu.T @ self.windows.weights
            curved = self.windows.condition.hessians(integrals, none, y.T)
            if np.any(curved):
                S = self._integral_jacobian(x)
                extra += np.einsum("wia,wij,wjb->ab", S, curved, S, optimize=True)
            if self._aux is not None:
                h = self._aux.hessians(self._factors(x), none, -y.T)
                blocks += [block.ravel() for block in h]
        else:
            n_w = 0
        C = self.coefficients(x)
        z = self._z(C, self._offset, self._B)
        extra += _assembled(self._s.hessians(z, self._p, load), self._B)
        if self.path_limits:
            assert self._path is not None
            h_load = np.zeros((self._path.size_out, self._path_t.size))
            np.add.at(h_load, (self._path_i, self._path_k), multipliers[n_a + n_w :] / self._path_scale)
            z = self._z(C, self._path_offset, self._path_B)
            extra += _assembled(self._path.hessians(z, self._path_p, h_load), self._path_B)
        data = np.bincount(
            self._H_order, weights=np.concatenate([extra.ravel(), *blocks]), minlength=self._H.nnz
        )
        return sp.csc_array((data, self._H.indices, self._H.indptr), self._H.shape)

    def row_words(self, row: int) -> str:
        n_a = self._A.shape[0]
        if row < n_a:
            return self._A_words[row]
        row -= n_a
        if self.windows is not None:
            n_w = self._count * self._rows_per_window
            if row < n_w:
                return self.windows.words[row // self._rows_per_window]
            row -= n_w
        return self.path_limits[row].words

    # ---- parts ----------------------------------------------------------------------------------------------------

    def _z(self, C: FloatArray, offset: FloatArray, B: FloatArray) -> FloatArray:
        return np.asarray((offset + np.matmul(C, B)).reshape(3 * self._m, -1))

    def _cached(self, x: FloatArray, name: str, make: Callable[[], FloatArray]) -> FloatArray:
        key = x[: self._nc].tobytes()
        if self._known[0] != key:
            self._known = (key, {})
        store = self._known[1]
        if name not in store:
            store[name] = make()
        return store[name]

    def _at_nodes(self, x: FloatArray) -> FloatArray:
        return self._z(self.coefficients(x), self._offset, self._B)

    def _values(self, x: FloatArray) -> FloatArray:
        return self._cached(x, "values", lambda: self._s.values(self._at_nodes(x), self._p))

    def _jacobians(self, x: FloatArray) -> FloatArray:
        return self._cached(x, "jacobians", lambda: self._s.jacobians(self._at_nodes(x), self._p))

    def _integrals(self, x: FloatArray) -> FloatArray:
        assert self.windows is not None
        weights = self.windows.weights
        return self._cached(x, "integrals", lambda: weights @ self._values(x))

    def _integral_jacobian(self, x: FloatArray) -> FloatArray:
        """(windows, integrands, coefficients)."""
        return self._cached(x, "integral_jacobian", lambda: self._make_integral_jacobian(x))

    def _make_integral_jacobian(self, x: FloatArray) -> FloatArray:
        assert self.windows is not None
        J = self._jacobians(x)
        n, out = J.shape[:2]
        J = J.reshape(n, out, 3, self._m)
        # (n, out m, 3) x (n, 3, nb), one small product an instant.
        V = np.matmul(J.transpose(0, 1, 3, 2).reshape(n, out * self._m, 3), self._B.transpose(2, 0, 1))
        return np.asarray((self.windows.weights @ V.reshape(n, -1)).reshape(self._count, out, self._nc))

    def _condition(self, x: FloatArray) -> FloatArray:
        assert self.windows is not None
        condition, none = self.windows.condition, np.empty((0, self._count))
        return self._cached(x, "condition", lambda: condition.values(self._integrals(x).T, none))

    def _factors(self, x: FloatArray) -> FloatArray:
        """(per window, windows)."""
        return x[self._nc : self._nc + self._ny].reshape(self._count, self._per_window).T

    def _path_values(self, x: FloatArray) -> FloatArray:
        assert self._path is not None
        path = self._path
        z = self._z(self.coefficients(x), self._path_offset, self._path_B)
        return self._cached(x, "path", lambda: path.values(z, self._path_p))

    def _path_jacobians(self, x: FloatArray) -> FloatArray:
        assert self._path is not None
        path = self._path
        z = self._z(self.coefficients(x), self._path_offset, self._path_B)
        return self._cached(x, "path_jacobians", lambda: path.jacobians(z, self._path_p))


def _assembled(H: FloatArray, B: FloatArray) -> FloatArray:
    """(coefficients, coefficients) from the Hessians of the instants (n, 3 m, 3 m) and the basis (3, nb, n)."""
    n, m, nb = H.shape[0], H.shape[1] // 3, B.shape[1]
    if n == 0:
        return np.zeros((m * nb, m * nb))
    blocks = H.reshape(n, 3, m, 3, m)
    # Right side first: T[k, d, j, i, b] = sum_e H[k, d, j, e, i] B[e, b, k], one small product an instant.
    T = np.matmul(blocks.transpose(0, 1, 2, 4, 3).reshape(n, 3 * m * m, 3), B.transpose(2, 0, 1))
    T = T.reshape(n * 3, m * m * nb)
    left = B.transpose(1, 2, 0).reshape(nb, n * 3)
    out = (left @ T).reshape(nb, m, m, nb)
    return np.ascontiguousarray(out.transpose(1, 0, 2, 3)).reshape(m * nb, m * nb)


def _fixed_pattern(
    rows: IntArray, columns: IntArray, shape: tuple[int, int]
) -> tuple[IntArray, sp.csc_array]:
    """Where each of a list of entries goes in the data of a CSC matrix, and that matrix."""
    key = columns * shape[0] + rows
    unique, order = np.unique(key, return_inverse=True)
    indptr = np.searchsorted(unique // max(shape[0], 1), np.arange(shape[1] + 1))
    matrix = sp.csc_array((np.zeros(unique.size), unique % max(shape[0], 1), indptr), shape=shape)
    return order, matrix
