"""The exceptions of factorgrasp: one tree, so that a caller can catch everything of ours at once."""

from __future__ import annotations


class FactorgraspError(Exception):
    """Base class of every error that factorgrasp raises on purpose."""


class InputError(FactorgraspError, ValueError):
    """The caller's data or settings cannot be used.

    Parameters
    ----------
    field : str
        What is wrong, as the caller names it: a file with its column, a key of the problem file, an argument.
    expected : str
        Shape, unit or range that would have been right.
    found : str
        What was there instead.
    hint : str, optional
        What would mend it.
    """

    def __init__(self, field: str, expected: str, found: str, hint: str = "") -> None:
        self.field = field
        self.expected = expected
        self.found = found
        self.hint = hint
        super().__init__(f"{field}: expected {expected}; found {found}" + (f". {hint}" if hint else ""))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        # Exceptions are pickled by their message alone; ours must survive a process boundary whole.
        return type(self), (self.field, self.expected, self.found, self.hint)


class SolverError(FactorgraspError):
    """A solver cannot be used for what was asked of it (unknown, not installed, or not capable)."""


class NotSolvedError(FactorgraspError):
    """A problem has no answer that may be used: unobservable, infeasible or not converged.

    The message says the reason in physical words and what would help.
    """


class UnobservableError(NotSolvedError):
    """The data say nothing about a quantity that was asked for."""


class InfeasibleError(NotSolvedError):
    """No value of the unknowns satisfies all constraints."""
