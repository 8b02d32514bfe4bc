"""The comparison: what it says of right, wrong, absent and incapable solvers, and the forms in which it says it."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from factorgrasp import lie
from factorgrasp.errors import InputError, SolverError
from factorgrasp.least_squares import Constraint, LeastSquares, QuadraticProgram, Term
from factorgrasp.losses import Huber
from factorgrasp.solvers import compare_cases
from factorgrasp.solvers.base import Solution, Solver, SolverOptions
from factorgrasp.solvers.compare import Comparison, ComparisonRow, compare
from factorgrasp.solvers.measure import environment, measure
from factorgrasp.solvers.registry import SOLVERS, solver_class
from factorgrasp.status import Status
from factorgrasp.tables import Column, Table, log10_summary, shifted_geometric_mean
from factorgrasp.typing import FloatArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract


def line_fit(*, tie: bool = False, bounded: bool = False, loss: Huber | None = None) -> LeastSquares:
    """Offset and slope of a line, in units of very different size."""
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 10.0, 30)
    y = 0.5 + 2e-3 * t + 1e-3 * rng.normal(size=t.size)
    if loss is not None:
        y[4] += 1.0
    problem = LeastSquares(
        [Variable("offset", 1, unit="m"), Variable("slope", 1, unit="m/s")],
        [Term("samples", t.size, ("offset", "slope"), Covariance.scalar(1e-6), loss, 1)],
        [Constraint("through", 1, ("offset", "slope"))] if tie else [],
    )
    problem.set_term("samples", {"offset": np.ones((t.size, 1)), "slope": t[:, None]}, y)
    if tie:
        problem.set_constraint("through", {"offset": [[1.0]], "slope": [[5.0]]}, [0.51])
    if bounded:
        problem.set_bounds("slope", -np.inf, 1e-3)
    return problem


class Direction:
    """A rotation from vectors seen in two frames."""

    kind = "direction"

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.a = rng.normal(size=(6, 3))
        self.b = self.a @ lie.so3_exp([0.4, -0.3, 0.9]).T + 1e-3 * rng.normal(size=(6, 3))
        self.variables = [Variable("R", 3, "rotation", "rad")]
        self.system = LeastSquares(self.variables, [Term("vectors", 18, ("R",), Covariance.scalar(1e-6))])

    def initial_state(self) -> State:
        return {"R": np.eye(3)}

    def linearize(self, state: State) -> LeastSquares:
        R = state["R"]
        blocks = -(R @ lie.skew(self.a)).reshape(-1, 3)
        self.system.set_term("vectors", {"R": blocks}, (self.b - self.a @ R.T).ravel())
        return self.system

    def retract(self, state: State, step: FloatArray) -> State:
        return retract(self.variables, state, step)

    def view(self, estimate: Any) -> Any:
        return estimate


def by_solver(found: Comparison, problem: str | None = None) -> dict[str, ComparisonRow]:
    return {row.solver: row for row in found.rows if problem in (None, row.problem)}


def test_right_answers_of_all_kinds_of_problems() -> None:
    found = compare(
        {
            "free": line_fit(),
            "tied": line_fit(tie=True),
            "bounded": line_fit(bounded=True),
            "robust": line_fit(loss=Huber()),
            "direction": Direction(),
        },
        solvers=["cholesky", "kkt", "gtsam", "osqp", "gtsam-levenberg-marquardt"],
        repeat=1,
    )
    assert len(found.rows) == 25
    for row in found.rows:
        if row.skipped:
            assert row.status == ""
            assert row.setup is None
            continue
        assert row.status == "solved", row
        assert row.correct is True, row
        assert row.relative_difference is not None
        assert abs(row.relative_difference) < 1e-9
        assert row.mean_difference is not None
        assert row.mean_difference < 1e-5, row
        assert row.setup is not None
        assert row.solve is not None
        assert row.warm is not None
        assert min(row.setup, row.solve, row.warm) >= 0.0
    assert by_solver(found, "tied")["cholesky"].skipped == "takes no equalities"
    assert by_solver(found, "bounded")["gtsam"].skipped == "takes no inequalities or bounds"
    assert by_solver(found, "tied")["kkt"].reference
    assert by_solver(found, "bounded")["osqp"].reference
    assert by_solver(found, "direction")["gtsam-levenberg-marquardt"].iterations > 1  # type: ignore[operator]


def test_objective_is_ours_and_the_same_for_all() -> None:
    problem = line_fit()
    found = compare(problem, solvers=["cholesky", "osqp"], repeat=1)
    matrix, rhs = problem.whitened()
    x = np.linalg.lstsq(matrix.toarray(), rhs, rcond=None)[0]
    for row in found.rows:
        assert row.problem == "LeastSquares"
        assert row.objective == pytest.approx(0.5 * float(np.sum((matrix @ x - rhs) ** 2)), rel=1e-9)


class Liar(Solver):
    """Claims to have solved what it has only looked at."""

    name = "liar"
    claim = Status.SOLVED
    off = 1e-3

    def setup(self, problem: LeastSquares) -> None:
        self.problem = problem

    def solve(self, row_weights: FloatArray | None = None, warm_start: Solution | None = None) -> Solution:
        matrix, rhs = self.problem.whitened(row_weights)
        x = np.linalg.lstsq(matrix.toarray(), rhs, rcond=None)[0]
        return Solution(x * (1.0 + self.off), self.claim)


@pytest.fixture
def liar(monkeypatch: pytest.MonkeyPatch) -> str:
    from factorgrasp.solvers import registry

    monkeypatch.setitem(SOLVERS, "liar", "tests:liar")
    original = registry._load

    def load(name: str, address: str) -> type[Solver]:
        return Liar if name == "liar" else original(name, address)

    monkeypatch.setattr(registry, "_load", load)
    return "liar"


@pytest.mark.parametrize(
    ("claim", "off", "correct"),
    [
        (Status.SOLVED, 1e-3, False),
        (Status.SOLVED, 0.0, True),
        (Status.NOT_CONVERGED, 1e-3, True),
        (Status.NOT_CONVERGED, 0.0, False),
        (Status.INFEASIBLE, 1e-3, False),
        (Status.UNOBSERVABLE, 1e-3, False),
    ],
)
def test_claims_are_checked(
    liar: str, monkeypatch: pytest.MonkeyPatch, claim: Status, off: float, correct: bool
) -> None:
    monkeypatch.setattr(Liar, "claim", claim)
    monkeypatch.setattr(Liar, "off", off)
    row = by_solver(compare(line_fit(), solvers=["cholesky", liar], repeat=1))[liar]
    assert row.correct is correct
    assert row.mean_difference is not None
    assert (row.mean_difference > 1.0) == (off > 0.0)
    assert row.relative_difference is not None
    assert (row.relative_difference > 1e-3) == (off > 0.0)


def test_infeasible_is_left_open_when_nobody_has_an_answer() -> None:
    problem = line_fit(tie=True, bounded=True)
    problem.set_constraint("through", {"offset": [[0.0]], "slope": [[1.0]]}, [0.5])
    row = compare(problem, solvers=["osqp"], repeat=1).rows[0]
    assert row.status == "infeasible"
    assert row.correct is None
    assert row.objective is None or np.isnan(row.objective)
    assert row.mean_difference is None


def test_unobservable_is_agreed_upon() -> None:
    problem = LeastSquares([Variable("a", 2)], [Term("sum", 1, ("a",))])
    problem.set_term("sum", {"a": [[1.0, 1.0]]}, [2.0])
    rows = by_solver(compare(problem, solvers=["cholesky", "gtsam"], repeat=1))
    assert rows["cholesky"].status == rows["gtsam"].status == "unobservable"
    assert rows["cholesky"].correct is True
    assert rows["gtsam"].correct is True


def test_quadratic_programs_are_judged_in_their_own_units() -> None:
    program = QuadraticProgram(
        sp.csc_array(np.eye(2)),
        np.array([-1.0, -2.0]),
        None,
        None,
        None,
        None,
        np.zeros(2),
        np.array([0.5, 5.0]),
        0.0,
    )
    found = compare([program], solvers=["osqp", "kkt"], options=SolverOptions(tolerance=1e-6), repeat=1)
    rows = by_solver(found)
    assert rows["osqp"].correct is True
    assert rows["osqp"].objective == pytest.approx(0.5 * 0.25 - 0.5 + 2.0 - 4.0, abs=1e-5)
    assert rows["osqp"].mean_difference is None
    assert rows["kkt"].skipped


def test_missing_solvers_are_rows_and_unknown_ones_are_errors() -> None:
    missing = [name for name in SOLVERS if not solver_class(name).installed()]
    if missing:
        row = by_solver(compare(line_fit(), solvers=[missing[0], "cholesky"], repeat=1))[missing[0]]
        assert "pip install" in row.skipped
    with pytest.raises(SolverError, match="unknown solver 'choleski'"):
        compare(line_fit(), solvers=["choleski"])
    with pytest.raises(InputError, match="problem"):
        compare([3], solvers=["cholesky"])  # type: ignore[list-item]


def test_default_is_every_installed_solver() -> None:
    found = compare([line_fit()], repeat=1)
    rows = by_solver(found)
    assert {name for name in SOLVERS if solver_class(name).installed()} == set(rows)
    assert rows["gtsam-isam2"].skipped == "for nonlinear problems"
    assert rows["osqp"].status == "solved"


def test_forms() -> None:
    found = compare({"one": line_fit(), "two": line_fit(tie=True)}, solvers=["cholesky", "kkt"], repeat=1)
    data = json.loads(found.json())
    assert [row["solver"] for row in data["rows"]] == ["cholesky", "kkt"] * 2
    assert data["rows"][2]["objective"] is None
    assert data["rows"][2]["skipped"] == "takes no equalities"
    assert data["conditions"]["python"]
    read = list(csv.DictReader(io.StringIO(found.csv())))
    assert float(read[0]["objective"]) == found.rows[0].objective
    assert read[2]["objective"] == ""
    assert "skipped: takes no equalities" in found.text()
    assert "| one | kkt * | solved | yes |" in found.markdown()
    assert str(found) == found.text()
    summary = found.summary()
    assert {row["solver"]: row["problems"] for row in summary.rows} == {"kkt": 2, "cholesky": 1}
    assert "100" in summary.text()


def test_single_problem_goes_into_the_title() -> None:
    table = compare({"grasp": line_fit()}, solvers=["cholesky"], repeat=1).table()
    assert table.title.startswith("grasp")
    assert "problem" not in [column.key for column in table.columns]


def test_measure_is_cold_then_warm() -> None:
    starts: list[Solution | None] = []
    made: list[int] = []
    answer = Solution(np.zeros(1), Status.SOLVED, setup_time=2.0, solve_time=3.0)

    def fresh() -> Any:
        made.append(1)

        def run(start: Solution | None) -> Solution:
            starts.append(start)
            return answer

        return run

    found, timing, _ = measure(fresh, 3, budget=10.0)
    assert found is answer
    assert timing.repeats == 3
    assert (timing.setup, timing.solve, timing.cold) == (2.0, 3.0, 5.0)
    assert len(made) == 4  # the first loads libraries and is not timed
    assert starts == [None] + [None, answer] * 3
    starts.clear()
    measure(lambda: lambda start: (starts.append(start), replace(answer, status=Status.INFEASIBLE))[1], 1)
    assert starts == [None, None, None]


def test_environment_says_what_it_was_made_on() -> None:
    where = environment(["numpy", "no-such-package"])
    assert where["numpy"] == np.__version__
    assert "no-such-package" not in where
    assert where["processor"]


def test_shifted_geometric_mean() -> None:
    assert shifted_geometric_mean([0.002, 0.002]) == pytest.approx(0.002)
    assert shifted_geometric_mean([0.0, 0.003], shift=1e-3) == pytest.approx(0.001)
    assert np.isnan(shifted_geometric_mean([]))


def test_log10_summary_ignores_noise_and_gaps() -> None:
    assert log10_summary([1e-6, 1e-4, 1e-2, float("nan")]) == pytest.approx((-4.0, -2.0))
    assert log10_summary([0.0, 1e-30]) == pytest.approx((-16.0, -16.0))
    assert np.isnan(log10_summary([])[0])


def test_rounding_and_millionths_are_forgiven_and_no_more() -> None:
    problem = line_fit()
    matrix, rhs = problem.whitened()
    x = np.linalg.lstsq(matrix.toarray(), rhs, rcond=None)[0]
    sd = 1.0 / np.sqrt(np.sum(matrix.toarray() ** 2, axis=0))

    def right(step: float) -> bool:
        found = Solution(x + step * sd, Status.SOLVED)
        return compare_cases._outcome(problem, found, compare_cases.Timing(0.0, 0.0, 0.0, 1), None).right(
            1e-9
        )

    assert right(0.0)
    assert right(1e-7)
    assert not right(1e-4)


def test_table_keeps_gaps_apart_from_zeros(tmp_path: Any) -> None:
    table = Table(
        (Column("name"), Column("time", "time", "ms", ".1f", 1e3), Column("ok"), Column("count")),
        (
            {"name": "a|b [c]", "time": 0.0, "ok": True, "count": 3},
            {"name": "", "time": float("nan"), "ok": None},
            {"name": "d", "time": float("inf"), "ok": np.bool_(False), "count": np.int64(4)},
        ),
        "Title",
        ("a note [with brackets]",),
    )
    assert table.cells() == [["a|b [c]", "0.0", "yes", "3"], ["-", "-", "-", "-"], ["d", "inf", "no", "4"]]
    assert "time [ms]" in table.text()
    assert "a|b [c]" in table.text()
    assert "a\\|b [c]" in table.markdown()
    assert "| --- | ---: | --- | ---: |" in table.markdown()
    assert table.csv().splitlines()[2] == ",,,"
    rows = json.loads(table.json())["rows"]
    assert rows[0] == {"name": "a|b [c]", "time": 0.0, "ok": True, "count": 3}
    assert rows[1] == {"name": None, "time": None, "ok": None, "count": None}
    assert rows[2]["time"] == "inf"
    for suffix in (".txt", ".md", ".csv", ".json"):
        path = table.write(tmp_path / f"table{suffix}")
        assert path.read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"\.txt"):
        table.write(tmp_path / "table.xls")
    with pytest.raises(InputError, match="form"):
        table.render("html")
