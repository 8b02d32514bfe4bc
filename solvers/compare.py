"""One table of what several solvers make of several problems: what they claim, whether it is true, how accurate, how fast.

Nothing here is taken from the solvers but their iterate and their claim: objective, residuals and gap are ours for all alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from factorgrasp.errors import InputError, SolverError
from factorgrasp.estimate import Certificate
from factorgrasp.least_squares import LeastSquares, QuadraticProgram
from factorgrasp.problem import LinearProblem, NonlinearProblem
from factorgrasp.solvers.base import SolverOptions
from factorgrasp.solvers.compare_cases import Case, LinearCase, NonlinearCase, Outcome, QuadraticCase
from factorgrasp.solvers.compare_program import ProgramCase
from factorgrasp.solvers.measure import environment
from factorgrasp.solvers.registry import solver_class, solver_names
from factorgrasp.status import Status
from factorgrasp.tables import Column, Table, is_missing, log10_summary, shifted_geometric_mean
from factorgrasp.typing import FloatArray

Comparable = LinearProblem | NonlinearProblem | LeastSquares | QuadraticProgram
"""What can be compared."""

TOLERANCES: Mapping[str, float] = {"low": 1e-3, "mid": 1e-6, "high": 1e-9}
"""The three tolerances of qpbenchmark, for primal residual, dual residual and gap."""

COLUMNS = (
    Column("problem"),
    Column("solver"),
    Column("status"),
    Column("correct"),
    Column("objective", format=".9g"),
    Column("relative_difference", "above best", format=".0e"),
    Column("primal", format=".0e"),
    Column("dual", format=".0e"),
    Column("gap", format=".0e"),
    Column("mean_difference", "off", "sd", ".0e"),
    Column("setup", "set-up", "ms", ".2f", 1e3),
    Column("solve", "solve", "ms", ".2f", 1e3),
    Column("warm", "warm", "ms", ".2f", 1e3),
    Column("iterations", "iter."),
)

HOW_TO_READ = (
    "correct: the claim (solved or not) agrees with our check. above best: objective above the best correct one, relative above 1.",
    "primal, dual, gap: largest violations in the problem's own units. off: largest difference of a mean to the reference solver's (*), "
    "in its standard deviations.",
    "set-up, solve: medians, cold. warm: everything again with the same values from the solution.",
)


@dataclass(frozen=True)
class ComparisonRow:
    """One solver on one problem.

    Attributes
    ----------
    problem, solver : str
    status : str
        The solver's claim; empty when it was skipped.
    correct : bool or None
        Whether the claim agrees with our check of its answer. That a problem is infeasible or unbounded is false when another solver has a
        right answer, and None otherwise.
    objective : float or None
        Ours, robust losses included.
    relative_difference : float or None
        To the lowest objective of a correct answer, relative to it where it is above one.
    primal, dual, gap : float or None
        Certificate in the units of the quadratic program (the last linearisation for a nonlinear problem).
    mean_difference : float or None
        Largest difference of a mean to the reference, in its standard deviations; None for a bare quadratic program.
    reference : bool
        Whether this row is the reference.
    setup, solve, warm : float or None
        Seconds, medians.
    iterations : int or None
    skipped : str
        Why it did not run.
    message : str
        The solver's own words.
    """

    problem: str
    solver: str
    status: str = ""
    correct: bool | None = None
    objective: float | None = None
    relative_difference: float | None = None
    primal: float | None = None
    dual: float | None = None
    gap: float | None = None
    mean_difference: float | None = None
    reference: bool = False
    setup: float | None = None
    solve: float | None = None
    warm: float | None = None
    iterations: int | None = None
    skipped: str = ""
    message: str = ""


@dataclass(frozen=True)
class Comparison:
    """What :func:`compare` found.

    Attributes
    ----------
    rows : tuple of ComparisonRow
        Problem by problem, in the order of the solvers.
    tolerance : float
    conditions : mapping
        Processor, versions and parameters.
    """

    rows: tuple[ComparisonRow, ...]
    tolerance: float
    conditions: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> Table:
        """All rows; columns that are empty throughout are left out of sight, and a single problem goes into the title."""
        rows = [asdict(row) | {"solver": row.solver + " *" * row.reference} for row in self.rows]
        for row in rows:
            row["status"] = row["status"] or f"skipped: {row['skipped']}"
        names = list(dict.fromkeys(row.problem for row in self.rows))
        columns = _seen(COLUMNS if len(names) > 1 else COLUMNS[1:], rows)
        title = (
            f"{names[0]}, tolerance {self.tolerance:g}"
            if len(names) == 1
            else f"Solvers, tolerance {self.tolerance:g}"
        )
        return Table(columns, tuple(rows), title, (*HOW_TO_READ, self._made_on()))

    def summary(self) -> Table:
        """One line a solver: shares, mean times and residuals over the problems that it took."""
        lines = []
        for name in dict.fromkeys(row.solver for row in self.rows):
            own = [row for row in self.rows if row.solver == name and not row.skipped]
            if own:
                lines.append(_summary_line(name, own))
        lines.sort(key=lambda line: (-line["correct"], line["cold"]))
        notes = (
            "cold, warm: shifted geometric means over the problems solved (shift 1 ms). log10: median / maximum over those.",
            self._made_on(),
        )
        return Table(
            SUMMARY_COLUMNS, tuple(lines), f"Solvers over all problems, tolerance {self.tolerance:g}", notes
        )

    def text(self, width: int | None = None) -> str:
        """For a terminal."""
        return self.table().text(width)

    def markdown(self) -> str:
        """For a page."""
        return self.table().markdown()

    def csv(self) -> str:
        """For a spreadsheet: seconds, full precision."""
        return Table(ALL_COLUMNS, tuple(asdict(row) for row in self.rows)).csv()

    def json(self) -> str:
        """For a program: seconds, full precision, with the conditions."""
        import json

        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings; missing values are None."""
        rows = Table(ALL_COLUMNS, tuple(asdict(row) for row in self.rows)).to_dict()["rows"]
        return {"tolerance": self.tolerance, "conditions": dict(self.conditions), "rows": rows}

    def __str__(self) -> str:
        return self.text()

    def _made_on(self) -> str:
        return "made on: " + ", ".join(f"{key} {value}" for key, value in self.conditions.items())


SUMMARY_COLUMNS = (
    Column("solver"),
    Column("problems"),
    Column("solved", "solved", "%", ".0f", 100.0),
    Column("correct", "correct", "%", ".0f", 100.0),
    Column("cold", "cold", "ms", ".2f", 1e3),
    Column("warm", "warm", "ms", ".2f", 1e3),
    Column("primal", "log10 primal"),
    Column("dual", "log10 dual"),
    Column("gap", "log10 gap"),
)
ALL_COLUMNS = tuple(Column(key) for key in ComparisonRow.__dataclass_fields__)


def compare(
    problems: Sequence[Comparable] | Mapping[str, Comparable] | Comparable,
    solvers: Sequence[str] | None = None,
    options: SolverOptions | None = None,
    repeat: int = 5,
) -> Comparison:
    """Solve problems with several solvers, and compare claims, accuracy and time.

    Parameters
    ----------
    problems : sequence, mapping from names, or one problem
        Problems of any kind: linear, nonlinear, a bare :class:`LeastSquares` or :class:`QuadraticProgram`.
    solvers : sequence of str, optional
        Names; all installed ones by default.
    options : SolverOptions, optional
        The same for all.
    repeat : int
        Repeats of every measurement.

    Returns
    -------
    Comparison
        A solver that is not installed or cannot take a problem has a row that says why.

    Raises
    ------
    SolverError
        When a name is unknown.
    InputError
        When a problem is of no known kind.
    """
    options = options or SolverOptions()
    names = list(solvers) if solvers is not None else solver_names(installed_only=True)
    for name in names:
        solver_class(name)
    rows: list[ComparisonRow] = []
    for title, case in _cases(problems):
        rows += _compare_one(title, case, names, options, repeat, named=solvers is not None)
    packages = ["factorgrasp", "numpy", "scipy", *dict.fromkeys(_packages(names))]
    conditions = environment(packages) | {"repeats": str(repeat)}
    return Comparison(tuple(rows), options.tolerance, conditions)


def _cases(
    problems: Sequence[Comparable] | Mapping[str, Comparable] | Comparable,
) -> Iterator[tuple[str, Case]]:
    if isinstance(problems, Mapping):
        for name, problem in problems.items():
            yield name, _case(problem)
        return
    single = isinstance(problems, QuadraticProgram | LeastSquares) or not isinstance(problems, Sequence)
    listed: list[Any] = [problems] if single else list(problems)  # type: ignore[arg-type]
    kinds = [str(getattr(problem, "kind", type(problem).__name__)) for problem in listed]
    for index, (kind, problem) in enumerate(zip(kinds, listed, strict=True)):
        again = kinds.count(kind) > 1
        yield f"{kind} {kinds[: index + 1].count(kind)}" if again else kind, _case(problem)


def _case(problem: Any) -> Case:
    if hasattr(problem, "nonlinear_program"):
        return ProgramCase(problem.nonlinear_program())
    if isinstance(problem, QuadraticProgram):
        return QuadraticCase(problem)
    if isinstance(problem, LeastSquares):
        return LinearCase(problem)
    if isinstance(problem, NonlinearProblem):
        return NonlinearCase(problem)
    if isinstance(problem, LinearProblem):
        return LinearCase(problem.least_squares())
    raise InputError("problem", "a problem, a LeastSquares or a QuadraticProgram", type(problem).__name__)


def _compare_one(
    title: str, case: Case, names: Sequence[str], options: SolverOptions, repeat: int, named: bool
) -> list[ComparisonRow]:
    outcomes: dict[str, Outcome] = {}
    skipped: dict[str, str] = {}
    for name in names:
        reason = _reason_to_skip(name, case, named)
        if not reason:
            try:
                outcomes[name] = case.run(name, options, repeat)
            except SolverError as error:
                reason = str(error)
        if reason:
            skipped[name] = reason
    reference = _reference(outcomes, options.tolerance)
    spread = case.spread(outcomes[reference]) if reference else None
    right = {name: o.right(options.tolerance) for name, o in outcomes.items()}
    best = min((outcomes[n].objective for n, ok in right.items() if ok), default=None)
    rows = []
    for name in names:
        if name in skipped:
            rows.append(ComparisonRow(title, name, skipped=skipped[name]))
            continue
        outcome = outcomes[name]
        certificate = outcome.certificate or Certificate(np.nan, np.nan, np.nan)
        rows.append(
            ComparisonRow(
                problem=title,
                solver=name,
                status=outcome.status.value,
                correct=_correct(outcome, right[name], any(right.values()), spread),
                objective=outcome.objective,
                relative_difference=None
                if best is None
                else (outcome.objective - best) / max(1.0, abs(best)),
                primal=certificate.primal,
                dual=certificate.dual,
                gap=certificate.gap,
                mean_difference=case.difference(outcomes[reference], outcome, spread) if reference else None,
                reference=name == reference,
                setup=outcome.timing.setup,
                solve=outcome.timing.solve,
                warm=outcome.timing.warm,
                iterations=outcome.iterations,
                message=outcome.message,
            )
        )
    return rows


def _correct(outcome: Outcome, right: bool, solvable: bool, spread: FloatArray | None) -> bool | None:
    """Whether a claim is true; None where nothing here can tell."""
    if outcome.status in (Status.INFEASIBLE, Status.UNBOUNDED):
        # Proven wrong by an answer of someone else; never proven right by our residuals alone.
        return False if solvable else None
    if outcome.status is Status.UNOBSERVABLE:
        return right or (bool(np.any(np.isinf(spread))) if spread is not None else None)
    return (outcome.status is Status.SOLVED) == right


def _reason_to_skip(name: str, case: Case, named: bool) -> str:
    kind = solver_class(name)
    if not kind.installed():
        return f"not installed: pip install {kind.pip}"
    if case.takes_program != kind.capabilities.program:
        return "takes no nonlinear program" if case.takes_program else "for nonlinear programs"
    if case.equalities and not kind.capabilities.equalities:
        return "takes no equalities"
    if case.inequalities and not kind.capabilities.inequalities:
        return "takes no inequalities or bounds"
    if case.quadratic and not kind.capabilities.inequalities:
        return "takes no bare quadratic program"
    if kind.capabilities.nonlinear and not case.nonlinear and not named:
        return "for nonlinear problems"
    return ""


def _reference(outcomes: Mapping[str, Outcome], tolerance: float) -> str:
    """Name of the most accurate correct outcome; a direct solver of ours where it is correct."""
    good = [name for name, outcome in outcomes.items() if outcome.right(tolerance)]
    for name in ("kkt", "cholesky"):
        if name in good:
            return name
    return min(good, key=lambda name: outcomes[name].error, default="")


def _packages(names: Sequence[str]) -> Iterator[str]:
    for name in names:
        yield from (part.partition(">")[0].strip("'\"") for part in solver_class(name).pip.split())


def _seen(columns: Sequence[Column], rows: Sequence[Mapping[str, Any]]) -> tuple[Column, ...]:
    return tuple(c for c in columns if not rows or any(not is_missing(row.get(c.key)) for row in rows))


def _summary_line(name: str, rows: Sequence[ComparisonRow]) -> dict[str, Any]:
    solved = [row for row in rows if row.status == Status.SOLVED.value]

    def spread(key: str) -> str | None:
        middle, worst = log10_summary([getattr(row, key) for row in solved])
        return f"{middle:.1f} / {worst:.1f}" if solved else None

    return {
        "solver": name,
        "problems": len(rows),
        "solved": len(solved) / len(rows),
        "correct": sum(bool(row.correct) for row in rows) / len(rows),
        "cold": shifted_geometric_mean([(row.setup or 0.0) + (row.solve or 0.0) for row in solved]),
        "warm": shifted_geometric_mean([row.warm or 0.0 for row in solved]),
        "primal": spread("primal"),
        "dual": spread("dual"),
        "gap": spread("gap"),
    }
