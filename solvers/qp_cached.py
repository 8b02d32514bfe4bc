"""Backends that keep their factorisation between solves of one pattern: set up once, then updated with new values."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from factorgrasp.errors import InputError
from factorgrasp.solvers.base import Solution
from factorgrasp.solvers.qp_form import QpForm
from factorgrasp.solvers.qp_oneshot import RawResult
from factorgrasp.typing import FloatArray, IntArray


class Pattern(NamedTuple):
    """What must stay for an update to be possible: the entries of P, G and A and which bounds exist."""

    P: tuple[IntArray, IntArray]
    G: tuple[IntArray, IntArray] | None
    A: tuple[IntArray, IntArray] | None
    lower: IntArray
    upper: IntArray

    @classmethod
    def of(cls, form: QpForm) -> Pattern:
        """Pattern of a form."""
        return cls(
            (form.P.indptr, form.P.indices),
            None if form.G is None else (form.G.indptr, form.G.indices),
            None if form.A is None else (form.A.indptr, form.A.indices),
            np.flatnonzero(np.isfinite(form.lb)) if form.lb is not None else np.empty(0, dtype=np.intp),
            np.flatnonzero(np.isfinite(form.ub)) if form.ub is not None else np.empty(0, dtype=np.intp),
        )

    def same(self, other: Pattern) -> bool:
        """Whether two patterns are equal."""
        for mine, theirs in ((self.P, other.P), (self.G, other.G), (self.A, other.A)):
            if (mine is None) != (theirs is None):
                return False
            if mine is None or theirs is None:
                continue
            if not all(np.array_equal(a, b) for a, b in zip(mine, theirs, strict=True)):
                return False
        return np.array_equal(self.lower, other.lower) and np.array_equal(self.upper, other.upper)


class CachedBackend(ABC):
    """A native solver object that is set up for a pattern and updated while the pattern holds."""

    fold_bounds = False

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)
        self._pattern: Pattern | None = None
        self._hessian: sp.csc_matrix | None = None

    def expect(self, hessian: sp.sparray) -> None:
        """Entries of P that may become non-zero; a product that happens to vanish then does not change the pattern."""
        self._hessian = sp.csc_matrix(hessian)
        self._hessian.sort_indices()

    def load(self, form: QpForm) -> None:
        """Bring new values in: an update while the pattern holds, else a set-up."""
        form = form if self._hessian is None else _widen(form, self._hessian)
        pattern = Pattern.of(form)
        if self._pattern is not None and self._pattern.same(pattern):
            self.update(form)
        else:
            self._pattern = None  # stays so when the set-up raises
            self.build(form)
            self._pattern = pattern

    @abstractmethod
    def build(self, form: QpForm) -> None:
        """Set up for the pattern and values of a form."""

    @abstractmethod
    def update(self, form: QpForm) -> None:
        """Put in new values of the same pattern."""

    @abstractmethod
    def run(self, form: QpForm, start: Solution | None) -> RawResult:
        """Solve what was loaded."""


def _widen(form: QpForm, hessian: sp.csc_matrix) -> QpForm:
    """The form with P on the wider pattern; as it is where P has entries outside."""
    P = form.P
    if P.nnz == hessian.nnz and np.array_equal(P.indices, hessian.indices):
        return form
    n = P.shape[0]
    wide = np.repeat(np.arange(n, dtype=np.int64) * n, np.diff(hessian.indptr)) + hessian.indices
    mine = np.repeat(np.arange(n, dtype=np.int64) * n, np.diff(P.indptr)) + P.indices
    places = np.searchsorted(wide, mine)
    if mine.size and (places[-1] >= wide.size or not np.array_equal(wide[places], mine)):
        return form
    data = np.zeros(wide.size)
    data[places] = P.data
    return replace(form, P=sp.csc_matrix((data, hessian.indices, hessian.indptr), shape=P.shape))


class _Stack:
    """Rows ``[G; A; I]`` as one csc matrix whose data are a permutation of those of its parts."""

    def __init__(self, form: QpForm, parts: tuple[str, ...], bounds: bool) -> None:
        self.parts = parts
        matrices: list[sp.csc_matrix] = []
        count = 0
        for part in parts:
            matrix = getattr(form, part)
            if matrix is not None:
                labels = np.arange(count + 1, count + matrix.nnz + 1, dtype=float)
                matrices.append(sp.csc_matrix((labels, matrix.indices, matrix.indptr), shape=matrix.shape))
                count += matrix.nnz
        self.ones = form.size if bounds else 0
        if bounds:
            labels = np.arange(count + 1, count + form.size + 1, dtype=float)
            matrices.append(sp.csc_matrix(sp.diags_array(labels)))
        n = form.size
        self._matrix = sp.vstack(matrices, format="csc") if matrices else sp.csc_matrix((0, n))
        self._matrix.sort_indices()
        self._order = self._matrix.data.astype(np.intp) - 1

    def data(self, form: QpForm) -> FloatArray:
        """Entries of the stack for the values of a form."""
        pieces = [getattr(form, part).data for part in self.parts if getattr(form, part) is not None]
        pieces.append(np.ones(self.ones))
        return np.asarray(np.concatenate(pieces)[self._order])

    def matrix(self, form: QpForm) -> sp.csc_matrix:
        """The stack for the values of a form."""
        source = self._matrix
        return sp.csc_matrix(
            (self.data(form), source.indices.astype(np.int32), source.indptr.astype(np.int32)),
            shape=source.shape,
        )


class _Triangle:
    """Upper triangle of P, its entries picked from those of the whole."""

    def __init__(self, P: sp.csc_matrix) -> None:
        columns = np.repeat(np.arange(P.shape[1]), np.diff(P.indptr))
        self.chosen = np.flatnonzero(P.indices <= columns)
        counts = np.bincount(columns[self.chosen], minlength=P.shape[1])
        self._indices = P.indices[self.chosen].astype(np.int32)
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._shape = P.shape

    def matrix(self, P: sp.csc_matrix) -> sp.csc_matrix:
        """The upper triangle of a P of the same pattern."""
        return sp.csc_matrix((P.data[self.chosen], self._indices, self._indptr), shape=self._shape)


class OsqpBackend(CachedBackend):
    """OSQP: the KKT pattern, the scaling and the step size stay; new values cost one refactorisation."""

    def build(self, form: QpForm) -> None:
        osqp: Any = import_module("osqp")

        self._bounds = form.lb is not None or form.ub is not None
        self._stack = _Stack(form, ("G", "A"), self._bounds)
        self._triangle = _Triangle(form.P)
        lower, upper = self._sides(form)
        self._solver: Any = osqp.OSQP()
        self._solver.setup(
            P=self._triangle.matrix(form.P),
            q=form.q,
            A=self._stack.matrix(form),
            l=lower,
            u=upper,
            verbose=False,
            **self.settings,
        )

    def update(self, form: QpForm) -> None:
        lower, upper = self._sides(form)
        matrices = {"Px": form.P.data[self._triangle.chosen]}
        if lower.size:
            matrices |= {"Ax": self._stack.data(form)}
        self._solver.update(q=form.q, l=lower, u=upper, **matrices)

    def run(self, form: QpForm, start: Solution | None) -> RawResult:
        osqp: Any = import_module("osqp")

        if start is not None:
            y, z, box = form.forward(start)
            self._solver.warm_start(x=start.x, y=np.concatenate([z, y, box] if self._bounds else [z, y]))
        else:
            # Without this OSQP would go on from its last iterate: a start that was not asked for.
            rows = self._stack.matrix(form).shape[0]
            self._solver.warm_start(x=np.zeros(form.size), y=np.zeros(rows))
        start_time = time.perf_counter()
        found = self._solver.solve(raise_error=False)
        elapsed = time.perf_counter() - start_time
        raw = osqp.SolverStatus(found.info.status_val).name
        m, k = 0 if form.h is None else form.h.size, 0 if form.b is None else form.b.size
        # At a certificate of infeasibility OSQP fills its iterate with a placeholder.
        usable = "INFEASIBLE" not in raw and found.x is not None and found.x[0] is not None
        x = np.asarray(found.x, dtype=float) if usable else None
        dual = (
            np.asarray(found.y, dtype=float)
            if usable
            else np.zeros(m + k + (form.size if self._bounds else 0))
        )
        return RawResult(
            raw, None, x, dual[m : m + k], dual[:m], dual[m + k :], int(found.info.iter), elapsed
        )

    @staticmethod
    def _sides(form: QpForm) -> tuple[FloatArray, FloatArray]:
        none = np.empty(0)
        h = none if form.h is None else form.h
        b = none if form.b is None else form.b
        lower, upper = [np.full(h.size, -np.inf), b], [h, b]
        if form.lb is not None or form.ub is not None:
            lower.append(np.full(form.size, -np.inf) if form.lb is None else form.lb)
            upper.append(np.full(form.size, np.inf) if form.ub is None else form.ub)
        return np.concatenate(lower), np.concatenate(upper)


class PiqpBackend(CachedBackend):
    """PIQP: the ordering and the symbolic factorisation stay."""

    def build(self, form: QpForm) -> None:
        piqp: Any = import_module("piqp")

        settings = dict(self.settings)
        dense = settings.pop("backend", "sparse") == "dense"
        self._solver: Any = piqp.DenseSolver() if dense else piqp.SparseSolver()
        self._dense = dense
        self._solver.settings.verbose = False
        for key, value in settings.items():
            if not hasattr(self._solver.settings, key):
                raise InputError(f"piqp option {key}", "a setting of piqp", "an unknown name")
            setattr(self._solver.settings, key, value)
        self._solver.setup(**self._values(form))

    def update(self, form: QpForm) -> None:
        self._solver.update(**self._values(form))

    def _values(self, form: QpForm) -> dict[str, Any]:
        n = form.size
        empty = sp.csc_matrix((0, n))
        G = empty if form.G is None else form.G
        A = empty if form.A is None else form.A
        return {
            "P": form.P.toarray() if self._dense else form.P,
            "c": form.q,
            "A": A.toarray() if self._dense else A,
            "b": np.empty(0) if form.b is None else form.b,
            "G": G.toarray() if self._dense else G,
            "h_u": np.empty(0) if form.h is None else form.h,
            "x_l": form.lb,
            "x_u": form.ub,
        }

    def run(self, form: QpForm, start: Solution | None) -> RawResult:
        start_time = time.perf_counter()
        status = self._solver.solve()
        elapsed = time.perf_counter() - start_time
        found = self._solver.result
        m, k = 0 if form.h is None else form.h.size, 0 if form.b is None else form.b.size
        box = found.z_bu - found.z_bl if form.lb is not None or form.ub is not None else np.empty(0)
        return RawResult(
            status.name,
            None,
            np.array(found.x),
            np.array(found.y) if k else np.empty(0),
            np.array(found.z_u) if m else np.empty(0),
            np.array(box),
            int(found.info.iter),
            elapsed,
        )


class ClarabelBackend(CachedBackend):
    """Clarabel: the ordering and the scaling stay; as an interior-point method it takes no start."""

    fold_bounds = True

    def build(self, form: QpForm) -> None:
        clarabel: Any = import_module("clarabel")

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        # Presolve removes rows, after which values can no longer be updated.
        settings.presolve_enable = False
        for key, value in self.settings.items():
            if not hasattr(settings, key):
                raise InputError(f"clarabel option {key}", "a setting of clarabel", "an unknown name")
            setattr(settings, key, value)
        cones = [] if form.b is None else [clarabel.ZeroConeT(form.b.size)]
        if form.h is not None:
            cones.append(clarabel.NonnegativeConeT(form.h.size))
        self._stack = _Stack(form, ("A", "G"), False)
        self._triangle = _Triangle(form.P)
        self._solver: Any = clarabel.DefaultSolver(
            self._triangle.matrix(form.P), form.q, self._stack.matrix(form), self._side(form), cones, settings
        )

    def update(self, form: QpForm) -> None:
        self._solver.update(
            P=form.P.data[self._triangle.chosen], q=form.q, A=self._stack.data(form), b=self._side(form)
        )

    def run(self, form: QpForm, start: Solution | None) -> RawResult:
        start_time = time.perf_counter()
        found = self._solver.solve()
        elapsed = time.perf_counter() - start_time
        k = 0 if form.b is None else form.b.size
        dual = np.array(found.z, dtype=float)
        return RawResult(
            str(found.status),
            None,
            np.array(found.x),
            dual[:k],
            dual[k:],
            np.empty(0),
            int(found.iterations),
            elapsed,
        )

    @staticmethod
    def _side(form: QpForm) -> FloatArray:
        return np.concatenate([side for side in (form.b, form.h, np.empty(0)) if side is not None])


CACHED: Mapping[str, type[CachedBackend]] = {
    "clarabel": ClarabelBackend,
    "osqp": OsqpBackend,
    "piqp": PiqpBackend,
}
"""Backends with a set-up that outlives a solve."""
