"""What counts as an answer of the constraint exchange: what the grid shows, not what a solver claims."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from factorgrasp.nonlinear_program import NlpSolution
from factorgrasp.solvers.nlp_exchange import NOT_THE_BEST, solve_by_exchange
from factorgrasp.status import Status


@dataclass(frozen=True)
class Least:
    """x >= 1 on a grid of one point, which becomes a row when it is violated."""

    rows: int = 0
    share: float = 1.0

    def program(self, space, points, start):
        held = points.rows > 0
        return SimpleNamespace(
            start=np.array([1.0 if held else 0.0]),
            coefficients=lambda x: x,
            row_lower=np.ones(1),
            row_upper=np.full(1, np.inf),
            row_words=lambda k: "x at least 1",
        )

    def eased(self, points, share):
        return points

    def check(self, space, C, points, needed=1.0):
        bad = C[0] < 1.0
        return SimpleNamespace(
            violated=("x",) if bad else (), share=self.share, points=replace(points, rows=points.rows + int(bad))
        )  # fmt: skip

    def first_points(self, space):
        return self


class Stub:
    """Answers with the start of a program and a status."""

    options = SimpleNamespace()

    def __init__(self, status: Status) -> None:
        self.status = status

    def solve_program(self, program, near=None):
        return NlpSolution(program.start, self.status, np.array([-1.0]), iterations=3, message="my words")


@pytest.mark.parametrize("status", [Status.SOLVED, Status.NOT_CONVERGED])
def test_an_answer_that_holds_on_the_grid_counts(status: Status) -> None:
    problem = Least(rows=1)
    result = solve_by_exchange(problem, None, Stub(status), np.zeros(1), problem)
    assert result.status is Status.SOLVED
    assert result.message == ("" if status is Status.SOLVED else NOT_THE_BEST)
    assert result.rounds == 1


def test_a_violated_limit_becomes_a_row() -> None:
    result = solve_by_exchange(Least(), None, Stub(Status.SOLVED), np.zeros(1))
    assert (result.status, result.rounds, result.points.rows) == (Status.SOLVED, 2, 1)
    assert result.binding == ("x at least 1",)
