"""Every installed QP backend on small Maros-Meszaros problems and on model-predictive-control problems.

Three tolerances, the same for all backends and strictly absolute; what a backend claims is checked by the Karush-Kuhn-Tucker residuals of
factorgrasp and by reference objectives. Cold and warm, set-up and iterations are timed apart. See benchmarks/README.md.

    OMP_NUM_THREADS=1 python benchmarks/solver_benchmark.py --data DATA_FOLDER [--solvers piqp,osqp] [--out benchmarks/results]
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.io import loadmat

from factorgrasp.least_squares import QuadraticProgram
from factorgrasp.solvers.base import Solution, SolverOptions
from factorgrasp.solvers.certificate import certify
from factorgrasp.solvers.measure import Solve, environment, measure
from factorgrasp.solvers.qp import MODULES, QpSession, solver_class
from factorgrasp.solvers.qp_options import KEYWORDS
from factorgrasp.status import Status
from factorgrasp.tables import Column, Table, log10_summary, shifted_geometric_mean

TOLERANCES = {"low": 1e-3, "mid": 1e-6, "high": 1e-9}
SETS = {
    "qp_maros_small": "Maros-Meszaros, 26 small problems",
    "qp_mpc": "model predictive control, 12 problems",
}
INFINITE = 9e19

LIMITATIONS = (
    "Problems of 2 to 133 unknowns: fixed costs (conversion, memory, Python) weigh more than on large ones.",
    "Times go through Python; set-up holds the conversion of the matrices, which a native caller would not pay.",
    "All problems are feasible and bounded: nothing is said on how infeasible ones are found out.",
    "ECOS and quadprog take positive definite problems only and say so on others: these count as failed for them.",
    "HiGHS runs without its own regularisation (qp_regularization_value = 0) and takes no tolerance below 1e-10.",
    "All backends keep their own iteration limits; only the tolerances are set. No parameter is tuned.",
    "Relative tolerances are zero here. In the library they are 1e-12, so that badly scaled problems can end.",
    "Published objectives have 9 digits: differences below 1e-8 mean nothing.",
    "Warm means: the same values again, from the last solution. A stream of changing values gains less.",
)


@dataclass(frozen=True)
class Case:
    """One benchmark problem with its reference objective."""

    collection: str
    name: str
    program: QuadraticProgram
    reference: float


def cases(folder: Path) -> Iterator[Case]:
    """The problems below a data folder."""
    for collection in SETS:
        answers = json.loads(
            (folder / collection / "ANSWERS_reference_objectives.json").read_text(encoding="utf-8")
        )
        for path in sorted((folder / collection).glob("*.[mn][ap][tz]")):
            answer = answers[path.stem]
            reference = answer["published"] if answer["published"] is not None else answer["consensus"]
            program = read_maros(path) if path.suffix == ".mat" else read_mpc(path)
            yield Case(collection, path.stem, program, float(reference))


def read_maros(path: Path) -> QuadraticProgram:
    """Rows ``l <= A x <= u`` whose last n are the bounds, as equalities, inequalities and bounds."""
    raw = loadmat(path)
    n = raw["P"].shape[0]
    rows = sp.csr_array(raw["A"])
    low, high = raw["l"].ravel().astype(float), raw["u"].ravel().astype(float)
    low, high = np.where(low <= -INFINITE, -np.inf, low), np.where(high >= INFINITE, np.inf, high)
    if abs(rows[-n:] - sp.eye_array(n)).nnz:
        raise ValueError(f"{path.name}: the last rows are not the bounds")
    body, low_body, high_body = rows[:-n], low[:-n], high[:-n]
    equal = low_body == high_body
    upper, lower = np.isfinite(high_body) & ~equal, np.isfinite(low_body) & ~equal
    G = sp.vstack([body[upper], -body[lower]], format="csc")
    bounded = np.any(np.isfinite(low[-n:])) or np.any(np.isfinite(high[-n:]))
    return QuadraticProgram(
        P=sp.csc_array(raw["P"].astype(float)),
        q=raw["q"].ravel().astype(float),
        G=sp.csc_array(G) if G.shape[0] else None,
        h=np.concatenate([high_body[upper], -low_body[lower]]) if G.shape[0] else None,
        A=sp.csc_array(body[equal]) if equal.any() else None,
        b=high_body[equal] if equal.any() else None,
        lb=low[-n:] if bounded else None,
        ub=high[-n:] if bounded else None,
        constant=float(raw["r"].ravel()[0]),
    )


def read_mpc(path: Path) -> QuadraticProgram:
    """The arrays P, q, G, h, A, b, lb, ub; absent ones are None."""
    with np.load(path, allow_pickle=True) as raw:  # absent parts are stored as a pickled None
        part = {key: None if raw[key].dtype == object else raw[key].astype(float) for key in raw.files}

    def matrix(key: str) -> sp.csc_array | None:
        return None if part[key] is None else sp.csc_array(part[key])

    P = matrix("P")
    assert P is not None
    return QuadraticProgram(
        P, part["q"], matrix("G"), part["h"], matrix("A"), part["b"], part["lb"], part["ub"], 0.0
    )


def strict_options(backend: str, tolerance: float, time_limit: float) -> SolverOptions:
    """One absolute tolerance and no relative one (ECOS insists on a number above zero)."""
    extra = dict.fromkeys(KEYWORDS[backend].relative, 1e-16 if backend == "ecos" else 0.0)
    return SolverOptions(tolerance=tolerance, time_limit=time_limit, extra=extra)


def run(case: Case, backend: str, tolerance: float, repeat: int, time_limit: float) -> dict[str, Any]:
    """One row: a problem, a backend, a tolerance."""
    options = strict_options(backend, tolerance, time_limit)

    def fresh() -> Solve:
        session = QpSession(backend, options)
        return lambda start: session.solve(case.program, start)

    found, timing, warm = measure(fresh, repeat)
    certificate = certify(case.program, found)
    claim = found.status is Status.SOLVED
    within = bool(certificate.within(tolerance))
    return {
        "set": case.collection,
        "problem": case.name,
        "solver": backend,
        "tolerance": tolerance,
        "status": found.status.value,
        "success": claim and within,
        # All problems here have a solution: that one is infeasible or unbounded is a false claim.
        "correct": claim == within and found.status not in (Status.INFEASIBLE, Status.UNBOUNDED),
        "objective": objective(case, found),
        "objective_difference": abs(objective(case, found) - case.reference) / max(1.0, abs(case.reference)),
        "primal": certificate.primal,
        "dual": certificate.dual,
        "gap": certificate.gap,
        "iterations": found.iterations,
        "warm_iterations": warm.iterations,
        "setup": timing.setup,
        "solve": timing.solve,
        "cold": timing.cold,
        "warm": timing.warm,
        "message": found.message,
    }


def objective(case: Case, found: Solution) -> float:
    """Our objective of whatever came back."""
    program = case.program
    return float(0.5 * found.x @ (program.P @ found.x) + program.q @ found.x) + program.constant


def summarize(rows: list[dict[str, Any]], time_limit: float) -> Iterator[Table]:
    """One table a set and tolerance, one line a backend, the most successful first."""
    for collection, words in SETS.items():
        for level, tolerance in TOLERANCES.items():
            chosen = [row for row in rows if row["set"] == collection and row["tolerance"] == tolerance]
            lines = [
                summary_line(backend, [row for row in chosen if row["solver"] == backend], time_limit)
                for backend in dict.fromkeys(row["solver"] for row in chosen)
            ]
            lines.sort(key=lambda line: (-line["success"], line["cold"]))
            yield Table(COLUMNS, tuple(lines), f"{words}; {level} tolerance {tolerance:g}")


COLUMNS = (
    Column("solver"),
    Column("success", "success", "%", ".0f", 100.0),
    Column("correct", "correct", "%", ".0f", 100.0),
    Column("setup", "set-up", "ms", ".2f", 1e3),
    Column("solve", "solve", "ms", ".2f", 1e3),
    Column("cold", "cold*", "ms", ".2f", 1e3),
    Column("warm", "warm*", "ms", ".2f", 1e3),
    Column("primal", "log10 primal"),
    Column("dual", "log10 dual"),
    Column("gap", "log10 gap"),
    Column("objective", "log10 objective"),
)


def summary_line(backend: str, rows: list[dict[str, Any]], time_limit: float) -> dict[str, Any]:
    """Shares, times and residuals of one backend on one set at one tolerance."""
    solved = [row for row in rows if row["success"]]
    claimed = [row for row in rows if row["status"] == Status.SOLVED.value]

    def penalised(key: str) -> float:
        return shifted_geometric_mean([row[key] if row["success"] else time_limit for row in rows])

    def spread(key: str) -> str | None:
        middle, worst = log10_summary([row[key] for row in claimed])
        return f"{middle:.1f} / {worst:.1f}" if claimed else None

    return {
        "solver": backend,
        "success": len(solved) / len(rows),
        "correct": sum(row["correct"] for row in rows) / len(rows),
        "setup": float(np.median([row["setup"] for row in solved])) if solved else None,
        "solve": float(np.median([row["solve"] for row in solved])) if solved else None,
        "cold": penalised("cold"),
        "warm": penalised("warm"),
        "primal": spread("primal"),
        "dual": spread("dual"),
        "gap": spread("gap"),
        "objective": spread("objective_difference"),
    }


def report(tables: list[Table], parameters: dict[str, str], where: dict[str, str]) -> str:
    """The whole page."""
    lines = ["# QP solvers", "", "## Conditions", ""]
    lines += [f"- {key}: {value}" for key, value in {**where, **parameters}.items()]
    lines += ["", "## How to read", ""]
    lines += [
        "- success: claims to have solved it, and primal residual, dual residual and duality gap (ours) are within the tolerance.",
        "- correct: the claim agrees with that check, be it solved or not; that a problem is infeasible or unbounded is false here.",
        "- set-up, solve: medians over the problems solved.",
        "- cold*, warm*: shifted geometric means over all problems (shift 1 ms); one that was not solved counts as the time limit.",
        "- log10 columns: median / maximum over the problems that it claims to have solved.",
        "- objective: difference to the reference objective, relative where that is above 1.",
        "",
        "## Limitations",
        "",
        *(f"- {line}" for line in LIMITATIONS),
        "",
    ]
    return "\n".join(lines) + "\n" + "\n".join(table.markdown() for table in tables)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("FACTORGRASP_DATA", "../shared/data")
    parser.add_argument(
        "--data", type=Path, default=Path(default), help="folder with qp_maros_small and qp_mpc"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results", help="folder for the results"
    )
    parser.add_argument("--solvers", default="", help="names, comma-separated; all installed ones by default")
    parser.add_argument("--repeat", type=int, default=5, help="repeats of every measurement")
    parser.add_argument(
        "--time-limit", type=float, default=10.0, help="seconds a solve, and the price of a failure"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None, say: Callable[[str], None] = print) -> None:
    """Run all and write ``solver_benchmark.{md,csv,json}``."""
    chosen = parse(arguments)
    names = (
        chosen.solvers.split(",") if chosen.solvers else [n for n in MODULES if solver_class(n).installed()]
    )
    problems = list(cases(chosen.data))
    rows: list[dict[str, Any]] = []
    for backend in names:
        for tolerance in TOLERANCES.values():
            rows += [run(case, backend, tolerance, chosen.repeat, chosen.time_limit) for case in problems]
        say(
            f"{backend}: {sum(row['success'] for row in rows if row['solver'] == backend)} of {3 * len(problems)}"
        )
    parameters = {
        "tolerances": ", ".join(f"{level} {value:g}" for level, value in TOLERANCES.items()),
        "relative tolerances": "0",
        "repeats": str(chosen.repeat),
        "time limit": f"{chosen.time_limit:g} s",
    }
    where = environment(
        ["factorgrasp", "numpy", "scipy", "qpsolvers", *(MODULES[n][1].split()[-1] for n in names)]
    )
    tables = list(summarize(rows, chosen.time_limit))
    page = report(tables, parameters, where)
    say(page)
    from factorgrasp.atomic import write_text

    write_text(chosen.out / "solver_benchmark.md", page)
    every = Table(
        tuple(Column(key) for key in rows[0]),
        tuple(rows),
        "QP solvers",
        tuple(f"{k}: {v}" for k, v in {**where, **parameters}.items()),
    )
    every.write(chosen.out / "solver_benchmark.csv")
    every.write(chosen.out / "solver_benchmark.json")


if __name__ == "__main__":
    main()
