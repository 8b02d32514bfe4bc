"""Gaussian elimination by gtsam: one least-squares problem as a factor graph, with equalities as constrained factors."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np

from factorgrasp.errors import InputError, SolverError
from factorgrasp.gtsam_view import GaussianView, load_gtsam, variable_of_error
from factorgrasp.least_squares import LeastSquares
from factorgrasp.solvers.base import Capabilities, Solution, Solver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

_RANK = 1e-13
"""A column counts as dependent on others when elimination leaves less than this of its norm."""


class GtsamElimination(Solver):
    """Variable elimination with a cached COLAMD ordering.

    ``extra={"elimination": "qr"}`` (the default) eliminates by Householder QR on the rows themselves, which keeps the digits that the
    normal equations lose, and names the variable that the data do not inform. ``"cholesky"`` is gtsam's own default (multifrontal); it is
    up to twice as fast and takes badly scaled problems for singular ones (rows of 1e6 beside rows of 1 in one variable).
    """

    name: ClassVar[str] = "gtsam"
    modules: ClassVar[tuple[str, ...]] = ("gtsam",)
    pip: ClassVar[str] = "'gtsam>=4.3'"
    capabilities: ClassVar[Capabilities] = Capabilities(equalities=True)

    def setup(self, problem: LeastSquares) -> None:
        """Cut the rows into factors; what was cut for the same pattern is kept.

        Raises
        ------
        SolverError
            When the problem has inequalities or bounds.
        """
        if problem.has_inequalities:
            raise SolverError(f"{self.name} takes no inequalities or bounds; use a QP solver such as piqp")
        self._elimination = self.options.extra.get("elimination", "qr")
        if self._elimination not in ("qr", "cholesky"):
            raise InputError("elimination", "'qr' or 'cholesky'", repr(self._elimination))
        self._problem = problem
        known: GaussianView | None = getattr(self, "_view", None)
        if known is not None and known.fits(problem):
            known.problem = problem
            return
        self._view = GaussianView(problem)
        self._ordering: Any = None

    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        """Build the graph of the current values and eliminate; `setup_time` holds the building (Python, a few us a factor)."""
        gtsam = load_gtsam()

        problem = self._problem
        start = time.perf_counter()
        graph = self._view.graph(row_weights)
        if self._ordering is None:
            self._ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
        built = time.perf_counter()
        x = np.full(problem.size, np.nan)
        y = np.zeros(problem.equalities.height)
        status, message, missing = Status.SOLVED, f"gtsam: eliminated by {self._elimination}", ""
        try:
            if self._elimination == "qr":
                net = graph.eliminateSequential(self._ordering, gtsam.EliminateQR)
                missing = self._dependent(net)
                if not missing:
                    x = self._view.vector(net.optimize())
            else:
                x = self._view.vector(graph.optimize(self._ordering))
        except RuntimeError as error:
            missing = variable_of_error(str(error), lambda key: self._view.keys.name.get(key, str(key)))
            message = "gtsam: " + " ".join(str(error).split())[:200]
            status = Status.UNOBSERVABLE if missing else Status.NUMERICAL_ERROR
        untouched = [v.name for v in problem.variables if np.all(np.isnan(x[problem.columns[v.name]]))]
        if missing or (untouched and status is Status.SOLVED):
            status = Status.UNOBSERVABLE
            message = f"the data do not inform {missing or ', '.join(untouched)} (given the other variables): add a measurement or a prior"
        elif status is Status.SOLVED:
            y, violation = self._multipliers(x, row_weights)
            if violation > 1e-6:
                status = Status.INFEASIBLE
                message = f"the equalities contradict each other: violated by {violation:.3g} at the least-squares answer"
        return Solution(
            x=x,
            status=status,
            y=y,
            iterations=1,
            setup_time=built - start,
            solve_time=time.perf_counter() - built,
            message=message,
        )

    def _dependent(self, net: Any) -> str:
        """Name of the first variable of which elimination left nothing; empty when there is none."""
        problem = self._problem
        norms = np.bincount(
            problem.jacobian.matrix.indices, weights=self._view.entries**2, minlength=problem.size
        )
        hard = problem.equalities.matrix
        norms = np.sqrt(norms + np.bincount(hard.indices, weights=hard.data**2, minlength=problem.size))
        for i in range(net.size()):
            conditional = net.at(i)
            name = self._view.keys.name[conditional.firstFrontalKey()]
            pivots = np.abs(np.diagonal(conditional.R()))
            # The row of an exact relation is scaled to a unit pivot: it is compared with one.
            scale = (
                np.minimum(norms[problem.columns[name]], 1.0)
                if conditional.isConstrained()
                else norms[problem.columns[name]]
            )
            if np.any(pivots <= _RANK * scale):
                return name
        return ""

    def _multipliers(self, x: FloatArray, row_weights: FloatArray | None) -> tuple[FloatArray, float]:
        """Multipliers of the equalities from stationarity, and their largest violation relative to the sizes in the row."""
        hard = self._problem.equalities
        if not hard.height:
            return np.empty(0), 0.0
        from scipy.sparse.linalg import lsqr

        matrix, rhs = self._problem.whitened(row_weights)
        gradient = matrix.T @ (matrix @ x - rhs)
        y = np.asarray(lsqr(hard.matrix.T.tocsr(), -gradient, atol=1e-14, btol=1e-14)[0])
        size = abs(hard.matrix) @ np.abs(x) + np.abs(hard.rhs) + 1e-300
        return y, float(np.max(np.abs(hard.matrix @ x - hard.rhs) / np.maximum(size, 1e-12)))
