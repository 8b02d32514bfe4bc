"""How a solve ended, in words of ours that are the same for every solver."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """End of a solve. Only `SOLVED` values may be used without a second look."""

    SOLVED = "solved"
    UNOBSERVABLE = "unobservable"
    """Converged, but the data did not inform at least one direction; the rest of the estimate holds."""
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    NOT_CONVERGED = "not_converged"
    """The iteration limit, the time limit or a stalled line search ended it; the last iterate is kept."""
    NUMERICAL_ERROR = "numerical_error"

    @property
    def ok(self) -> bool:
        """Whether the estimate answers the question."""
        return self is Status.SOLVED
