"""What a problem must offer so that any capable solver can take it."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares
from factorgrasp.typing import FloatArray, State


@runtime_checkable
class LinearProblem(Protocol):
    """A problem that is one linear least-squares problem."""

    kind: str

    def least_squares(self) -> LeastSquares:
        """The problem with its current values filled in."""
        ...

    def view(self, estimate: Estimate) -> Any:
        """The typed view of an estimate (an :class:`Estimate` subclass or wrapper)."""
        ...


@runtime_checkable
class NonlinearProblem(Protocol):
    """A problem that is solved by repeated linearisation on its manifold.

    Three optional methods are used where a problem has them:

    - ``refine(state) -> NonlinearProblem | None``: the problem posed afresh at a converged state (weights estimated from the residuals,
      clocks shifted), or None when nothing would change;
    - ``escape(state) -> state | None``: another start when `state` is not the global optimum, None when it is certified;
    - ``score_covariance(state) -> (n, n)``: covariance of the gradient at `state` where it differs from the information matrix
      (forgetting, correlated residuals); the covariance of the estimate is then the sandwich ``H^-1 M H^-1``;
    - ``factor_graph(state) -> gtsam.NonlinearFactorGraph`` with ``graph_values`` / ``graph_state`` for the conversions of the state.
    """

    kind: str

    def initial_state(self) -> State:
        """Where to start."""
        ...

    def linearize(self, state: State) -> LeastSquares:
        """Rows of ``r(state [+] d) ~ A d - b`` for the tangent step d; the same object may be refilled by later calls."""
        ...

    def retract(self, state: State, step: FloatArray) -> State:
        """Move `state` by a tangent step (n,)."""
        ...

    def view(self, estimate: Estimate) -> Any:
        """The typed view of an estimate."""
        ...


Problem = LinearProblem | NonlinearProblem
