"""The solvers of nonlinear programs that come with CasADi: ipopt, fatrop, and SQP over active-set QP solvers.

The program evaluates itself in numpy; one callback hands CasADi whichever derivative a solver asks for.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp

from factorgrasp.nonlinear_program import NlpSolution, NonlinearProgram
from factorgrasp.solvers.nlp import NlpSolver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

_WORDS = {
    "Solve_Succeeded": Status.SOLVED,
    "Solved_To_Acceptable_Level": Status.SOLVED,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Search_Direction_Becomes_Too_Small": Status.NOT_CONVERGED,
    "Maximum_Iterations_Exceeded": Status.NOT_CONVERGED,
    "Maximum_CpuTime_Exceeded": Status.NOT_CONVERGED,
    "Maximum_WallTime_Exceeded": Status.NOT_CONVERGED,
    "Restoration_Failed": Status.INFEASIBLE,
    "Diverging_Iterates": Status.UNBOUNDED,
}


_FLOOR = 1e-6


class CasadiNlp(NlpSolver):
    """A plugin of ``casadi.nlpsol``."""

    plugin: ClassVar[str]
    modules: ClassVar[tuple[str, ...]] = ("casadi",)
    pip: ClassVar[str] = "casadi"
    convex: ClassVar[bool] = False
    """Whether the Hessian has to be positive definite: its eigenvalues are then raised to a floor."""

    def plugin_options(self, warm: bool) -> dict[str, Any]:
        """What the plugin is told, from our options."""
        return dict(self.options.extra)

    def solve_program(self, program: NonlinearProgram, warm_start: NlpSolution | None = None) -> NlpSolution:
        import casadi

        began = time.perf_counter()
        oracle = _Oracle(program, self.convex)
        options = {
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            **self.plugin_options(warm_start is not None),
        }
        with _silence():
            solver = casadi.nlpsol("nlp", self.plugin, oracle.function, options)
        inputs: dict[str, Any] = {
            "x0": program.start if warm_start is None else warm_start.x,
            "lbx": program.lower, "ubx": program.upper, "lbg": program.row_lower, "ubg": program.row_upper,
        }  # fmt: skip
        if warm_start is not None and warm_start.multipliers.size == program.row_lower.size:
            inputs["lam_g0"] = warm_start.multipliers
            if warm_start.bound_multipliers.size:
                inputs["lam_x0"] = warm_start.bound_multipliers
        ready = time.perf_counter()
        try:
            with _silence():
                found = solver(**inputs)
            stats = solver.stats()
        except RuntimeError as error:
            if oracle.failure is not None:
                raise oracle.failure from error
            return NlpSolution(
                np.array(inputs["x0"]), Status.NUMERICAL_ERROR, setup_time=ready - began,
                solve_time=time.perf_counter() - ready, message=str(error).splitlines()[-1][:200],
            )  # fmt: skip
        if oracle.failure is not None:
            raise oracle.failure
        x, y, z = (np.array(found[key]).ravel() for key in ("x", "lam_g", "lam_x"))
        words = str(stats.get("return_status", ""))
        status = self.status(words, bool(stats.get("success", False)))
        iterations = int(stats.get("iter_count", 0))
        return NlpSolution(
            x, status, y, z, iterations, ready - began, time.perf_counter() - ready, words.replace("_", " ")
        )

    def status(self, words: str, success: bool) -> Status:
        """Our word for the plugin's."""
        if success:
            return Status.SOLVED
        return _WORDS.get(words, Status.NOT_CONVERGED)


class Ipopt(CasadiNlp):
    """Primal-dual interior point with filter line search (Waechter and Biegler 2006)."""

    name: ClassVar[str] = "ipopt"
    plugin: ClassVar[str] = "ipopt"

    def plugin_options(self, warm: bool) -> dict[str, Any]:
        own: dict[str, Any] = {
            "print_level": 0,
            "sb": "yes",
            "tol": self.options.tolerance,
            "max_iter": self.options.max_iterations or 200,
            "mu_strategy": "adaptive",
        }
        if warm:
            # The point is known to be near, its multipliers are not: rows may have been added since.
            own |= {"mu_strategy": "monotone", "mu_init": 1e-3, "bound_push": 1e-4, "bound_frac": 1e-4}
        if self.options.time_limit is not None:
            own["max_wall_time"] = self.options.time_limit
        return {"ipopt": own | self.options.extra}


class Fatrop(CasadiNlp):
    """The interior-point solver of Vanroye et al. 2023, here without a time structure to exploit."""

    name: ClassVar[str] = "fatrop"
    plugin: ClassVar[str] = "fatrop"

    def plugin_options(self, warm: bool) -> dict[str, Any]:
        own: dict[str, Any] = {
            "tol": self.options.tolerance,
            "max_iter": self.options.max_iterations or 500,
            "print_level": 0,
        }
        return {"structure_detection": "none", "fatrop": own | self.options.extra}


class SqpMethod(CasadiNlp):
    """CasADi's SQP with exact Hessians, made convex, over the active-set solver qpOASES.

    Of the QP solvers that come with CasADi, qpOASES and daqp solve the excitation programs; qrqp, osqp, highs, ipqp and proxqp do not.
    """

    name: ClassVar[str] = "sqpmethod"
    plugin: ClassVar[str] = "sqpmethod"
    convex: ClassVar[bool] = True

    def plugin_options(self, warm: bool) -> dict[str, Any]:
        own: dict[str, Any] = {
            "qpsol": "qpoases",
            "qpsol_options": {"printLevel": "none", "error_on_fail": False},
            "print_iteration": False,
            "print_header": False,
            "print_status": False,
            "max_iter": self.options.max_iterations or 200,
            "tol_pr": self.options.tolerance,
            "tol_du": self.options.tolerance,
        }
        return own | self.options.extra


class _Oracle:
    """The function that CasADi sees, and every derivative of it that a solver asked for."""

    def __init__(self, program: NonlinearProgram, convex: bool) -> None:
        import casadi

        self.program, self.convex = program, convex
        self.failure: Exception | None = None
        self.kept: list[Any] = []  # CasADi does not hold its callbacks
        n, m = program.start.size, program.row_lower.size
        x = program.start
        self._jacobian = _pattern(program.jacobian(x))
        full = sp.csc_array(program.hessian(x, 1.0, np.ones(m)))
        self._hessian = _pattern(full)
        rows, columns = full.indices, np.repeat(np.arange(n), np.diff(full.indptr))
        self._upper = rows <= columns
        triangle = _pattern(sp.csc_array(sp.triu(_ones(full))))
        dense = casadi.Sparsity.dense
        self.sparsities = {
            "x": dense(n, 1), "p": dense(0, 1), "lam:f": dense(1, 1), "lam:g": dense(m, 1), "f": dense(1, 1), "g": dense(m, 1),
            "grad:f:x": dense(n, 1), "jac:g:x": self._jacobian, "hess:gamma:x:x": self._hessian, "triu:hess:gamma:x:x": triangle,
            "grad:gamma:x": dense(n, 1), "grad:gamma:p": dense(0, 1),
        }  # fmt: skip
        self._triangle = triangle
        self.function = self.make("nlp", ["x", "p"], ["f", "g"])

    def value(self, key: str, given: dict[str, FloatArray]) -> Any:
        import casadi

        x, program = given["x"], self.program
        if key == "f":
            return program.objective(x)
        if key == "g":
            return casadi.DM(program.rows(x))
        if key == "grad:f:x":
            return casadi.DM(program.gradient(x))
        if key == "jac:g:x":
            return casadi.DM(self._jacobian, program.jacobian(x).data)
        if key == "grad:gamma:p":
            return casadi.DM(0, 1)
        factor = float(given["lam:f"][0]) if given["lam:f"].size else 0.0
        if key == "grad:gamma:x":
            return casadi.DM(factor * program.gradient(x) + program.jacobian(x).T @ given["lam:g"])
        found = program.hessian(x, factor, given["lam:g"])
        data = _raised(found) if self.convex else found.data
        if key.startswith("triu"):
            return casadi.DM(self._triangle, data[self._upper])
        return casadi.DM(self._hessian, data)

    def make(self, name: str, ins: Sequence[str], outs: Sequence[str]) -> Any:
        made = _callback_class()(self, name, list(ins), list(outs))
        self.kept.append(made)
        return made


def _raised(hessian: sp.csc_array) -> FloatArray:
    """Entries of the nearest matrix whose eigenvalues are at least the floor; a block-diagonal pattern stays what it is."""
    values, vectors = np.linalg.eigh(hessian.toarray())
    raised = (vectors * np.maximum(values, _FLOOR * max(1.0, float(np.max(np.abs(values)))))) @ vectors.T
    columns = np.repeat(np.arange(hessian.shape[1]), np.diff(hessian.indptr))
    return np.asarray(raised[hessian.indices, columns])


def _callback_class() -> Callable[..., Any]:
    """The subclass of ``casadi.Callback``, made when casadi is first needed."""
    global _CALLBACK
    if _CALLBACK is None:
        import casadi

        class Callback(casadi.Callback):
            def __init__(self, oracle: _Oracle, name: str, ins: list[str], outs: list[str]) -> None:
                casadi.Callback.__init__(self)
                self.owner, self.ins, self.outs = oracle, ins, outs
                self.construct(name, {})

            def get_n_in(self) -> int:
                return len(self.ins)

            def get_n_out(self) -> int:
                return len(self.outs)

            def get_name_in(self, k: int) -> str:
                return self.ins[k].replace(":", "_")

            def get_name_out(self, k: int) -> str:
                return self.outs[k].replace(":", "_")

            def get_sparsity_in(self, k: int) -> Any:
                return self.owner.sparsities[self.ins[k]]

            def get_sparsity_out(self, k: int) -> Any:
                return self.owner.sparsities[self.outs[k]]

            def eval(self, arguments: Sequence[Any]) -> list[Any]:
                given = {key: value.full().ravel() for key, value in zip(self.ins, arguments, strict=True)}
                try:
                    return [self.owner.value(key, given) for key in self.outs]
                except Exception as error:
                    # CasADi would print it and go on; the caller raises it again.
                    self.owner.failure = error
                    raise

            def get_factory(self, name: str, ins: Sequence[str], outs: Sequence[str], aux: Any, options: Any) -> Any:  # fmt: skip
                return self.owner.make(name, ins, outs)

        _CALLBACK = Callback
    return _CALLBACK


_CALLBACK: Callable[..., Any] | None = None


def _ones(matrix: sp.csc_array) -> sp.csc_array:
    return sp.csc_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)


def _pattern(matrix: sp.csc_array) -> Any:
    casadi: Any = import_module("casadi")
    return casadi.Sparsity(*matrix.shape, matrix.indptr.tolist(), matrix.indices.tolist())


@contextmanager
def _silence() -> Iterator[None]:
    """Some solvers print from C whatever they are told; what they print is of no use to anyone."""
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)
