"""What an estimate says, writes and reads back; and what importing the package costs."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import factorgrasp
from factorgrasp import lie
from factorgrasp.errors import InputError, UnobservableError
from factorgrasp.estimate import Certificate, Estimate, TermSummary
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.losses import Huber
from factorgrasp.observability import default_words, observe
from factorgrasp.provenance import problem_hash, versions
from factorgrasp.solvers.solve import solve
from factorgrasp.status import Status
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable


def handmade(covariance: np.ndarray, status: Status = Status.SOLVED) -> Estimate:
    """A rotation, a position and a pose with a given joint covariance (12, 12)."""
    variables = (
        Variable("rotation", 3, "rotation", "rad", resolution=0.02),
        Variable("lever arm", 3, unit="m", components=("x", "y", "z")),
        Variable("pose", 6, "pose"),
    )
    turn = lie.so3_exp(np.array([0.1, -0.2, 0.3]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [1.0, 2.0, 3.0]
    values = {"rotation": turn, "lever arm": np.array([0.1, 0.2, 0.3]), "pose": pose}
    return Estimate(
        status=status,
        kind="handmade",
        solver="none",
        variables=variables,
        values=values,
        message="because" if status is not Status.SOLVED else "",
        residuals=(
            TermSummary("gyroscope", 30, 33.0, 1.05, 2.5),
            TermSummary("gap", 0, 0.0, float("nan"), 0.0, 0.25),
        ),
        observability=observe(
            variables, lambda name: covariance[:3, :3], default_words, "turn about the other axis"
        ),
        objective=16.5,
        iterations=3,
        certificate=Certificate(1e-9, 2e-9, float("nan")),
        timing={"solve": 0.001, "total": 0.002},
        versions={"numpy": np.__version__},
        problem_hash="abc",
        multipliers={"limit": np.array([0.0, 2.5])},
        covariance_source=lambda columns: covariance @ columns,
    )


@pytest.fixture
def covariance(rng: np.random.Generator) -> np.ndarray:
    root = 0.003 * rng.normal(size=(12, 12))
    return root @ root.T


@pytest.fixture
def unobservable() -> Estimate:
    """The sum of two gains is known, but neither of them; the bias is."""
    problem = LeastSquares(
        [Variable("gains", 2, resolution=1.0), Variable("bias", 1, unit="m/s^2", resolution=1.0)],
        [Term("sum", 1, ("gains",)), Term("bias", 1, ("bias",), Covariance.scalar(0.04))],
    )
    problem.set_term("sum", {"gains": [[1.0, 1.0]]}, [3.0])
    problem.set_term("bias", {"bias": [[1.0]]}, [0.5])
    return solve(problem)


def equal(a: Estimate, b: Estimate) -> None:
    assert (a.status, a.kind, a.solver, a.message, a.variables) == (
        b.status,
        b.kind,
        b.solver,
        b.message,
        b.variables,
    )
    assert (a.iterations, a.problem_hash, a.versions, a.timing) == (
        b.iterations,
        b.problem_hash,
        b.versions,
        b.timing,
    )
    for mine, theirs in ((a.values, b.values), (a.multipliers, b.multipliers)):
        assert list(mine) == list(theirs)
        for name, value in mine.items():
            np.testing.assert_array_equal(value, theirs[name])
    np.testing.assert_equal(a.to_dict(), b.to_dict())
    assert repr(a.residuals) == repr(b.residuals)
    assert repr(a.certificate) == repr(b.certificate)
    assert (a.observability is None) == (b.observability is None)
    if a.observability is not None and b.observability is not None:
        assert a.observability.complete == b.observability.complete
        assert a.observability.advice == b.observability.advice
        for mine_, theirs_ in zip(a.observability.directions, b.observability.directions, strict=True):
            np.testing.assert_equal(mine_.to_dict(), theirs_.to_dict())
            assert mine_.observable == theirs_.observable


# ---- on disk ----------------------------------------------------------------------------------------------------


def test_what_was_saved_comes_back(tmp_path: Path, covariance: np.ndarray) -> None:
    estimate = handmade(covariance)
    path = estimate.save(tmp_path / "new" / "folder")
    assert path.name == "estimate.json"
    loaded = Estimate.load(path.parent)
    equal(estimate, loaded)
    np.testing.assert_allclose(loaded.covariance(), covariance, rtol=1e-14)
    np.testing.assert_allclose(
        loaded.covariance("pose", "lever arm"), estimate.covariance("pose", "lever arm")
    )
    assert sorted(p.name for p in path.parent.iterdir()) == ["estimate.json", "estimate.npz"]


def test_a_real_estimate_comes_back(tmp_path: Path, rng: np.random.Generator) -> None:
    problem = LeastSquares(
        [Variable("x", 4, resolution=1.0)],
        [Term("rows", 9, ("x",), loss=Huber(), group=3)],
        [Constraint("sum", 1, ("x",))],
    )
    problem.set_term("rows", {"x": rng.normal(size=(9, 4))}, 5.0 * rng.normal(size=9))
    problem.set_constraint("sum", {"x": np.ones((1, 4))}, 1.0)
    problem.set_bounds("x", -0.5, np.inf)
    estimate = solve(problem)
    loaded = Estimate.load(estimate.save(tmp_path).parent)
    equal(estimate, loaded)
    np.testing.assert_allclose(loaded.covariance(), estimate.covariance(), atol=1e-16)
    assert set(loaded.multipliers) == {"sum", "bounds of x"}


def test_json_holds_finite_numbers_only(tmp_path: Path, unobservable: Estimate) -> None:
    text = unobservable.save(tmp_path).read_text()

    def refuse(word: str) -> float:
        raise AssertionError(f"{word} in the file")

    stored = json.loads(text, parse_constant=refuse)
    assert stored["variables"][0]["sd"] == [None, None]
    assert stored["observability"]["directions"][0]["sd"] is None
    loaded = Estimate.load(tmp_path)
    equal(unobservable, loaded)
    assert loaded.observability is not None
    assert loaded.observability.missing[0].sd == np.inf
    np.testing.assert_array_equal(loaded.covariance(), unobservable.covariance())
    assert loaded.sd("bias") == pytest.approx(0.2)


def test_nothing_is_pickled(tmp_path: Path, covariance: np.ndarray) -> None:
    handmade(covariance).save(tmp_path)
    with np.load(tmp_path / "estimate.npz", allow_pickle=False) as file:
        assert {file[name].dtype.kind for name in file.files} == {"f"}


def test_a_failed_save_leaves_the_last_one(tmp_path: Path, covariance: np.ndarray) -> None:
    estimate = handmade(covariance)
    estimate.save(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def broken(columns: np.ndarray) -> np.ndarray:
        raise RuntimeError("the disk is on fire")

    from dataclasses import replace

    with pytest.raises(RuntimeError, match="fire"):
        replace(estimate, covariance_source=broken).save(tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_large_problems_keep_the_covariance_of_every_variable(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    names = [f"link {i}" for i in range(150)]
    problem = LeastSquares(
        [Variable(name, 3) for name in names],
        [Term(f"row {name}", 3, (name,), Covariance.diagonal(rng.uniform(0.1, 2.0, 3))) for name in names]
        + [Term(f"tie {a} {b}", 3, (a, b)) for a, b in itertools.pairwise(names)],
    )
    for term in problem.terms.values():
        problem.set_term(term.name, {v: rng.normal(size=(3, 3)) for v in term.variables}, rng.normal(size=3))
    estimate = solve(problem)
    loaded = Estimate.load(estimate.save(tmp_path).parent)
    for name in names[::40]:
        np.testing.assert_allclose(loaded.covariance(name), estimate.covariance(name), rtol=1e-12)
    with pytest.raises(UnobservableError, match="link 0 with link 1"):
        loaded.covariance("link 0", "link 1")


def test_a_folder_without_an_estimate_is_named(tmp_path: Path, covariance: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"no .*estimate\.json"):
        Estimate.load(tmp_path)
    handmade(covariance).save(tmp_path)
    stored = json.loads((tmp_path / "estimate.json").read_text())
    (tmp_path / "estimate.json").write_text(json.dumps({**stored, "format": "another"}))
    with pytest.raises(InputError, match="format"):
        Estimate.load(tmp_path)
    (tmp_path / "estimate.json").write_text("{")
    with pytest.raises(InputError, match=r"Estimate\.save"):
        Estimate.load(tmp_path)


# ---- tables and text --------------------------------------------------------------------------------------------


def test_dataframe(covariance: np.ndarray) -> None:
    pytest.importorskip("pandas")
    table = handmade(covariance).to_dataframe()
    assert list(table.columns) == ["variable", "component", "value", "sd", "unit"]
    assert len(table) == 12
    np.testing.assert_allclose(table["value"][:3], [0.1, -0.2, 0.3])
    np.testing.assert_allclose(table["value"][6:], [1.0, 2.0, 3.0, 0.1, -0.2, 0.3])
    np.testing.assert_allclose(table["sd"], np.sqrt(np.diag(covariance)))


def test_dataset(covariance: np.ndarray) -> None:
    pytest.importorskip("xarray")
    data = handmade(covariance).to_xarray()
    np.testing.assert_allclose(data["covariance"], covariance, rtol=1e-12)
    assert data["sd"].sel(component="lever arm/y") == pytest.approx(np.sqrt(covariance[4, 4]))


def test_summary_shows_values_with_their_sd(covariance: np.ndarray) -> None:
    covariance = covariance.copy()
    covariance[:3, :3] = np.diag([1e-6, 4e-6, 1e-3])
    lines = handmade(covariance).summary().splitlines()
    assert lines[0].startswith("handmade: solved by none in 2 ms, 3 iterations, objective 16.5")
    row = next(line for line in lines if "rotation[1]" in line)
    assert row.split() == ["rotation[1]", "-0.2", "+-", "0.002", "rad"]
    starts = {line.index("+-") for line in lines if "+-" in line}
    assert len(starts) == 1, "the standard deviations must stand below each other"
    assert any(line.split()[:3] == ["gyroscope", "30", "1.05"] for line in lines)
    assert any("25.0 %" in line for line in lines)
    missing = [line for line in lines if "needed 0.02 rad" in line]
    assert len(missing) == 1
    assert "rotation[2]" in missing[0]
    assert "turn about the other axis" in lines[-1]


def test_summary_of_what_is_not_known(unobservable: Estimate) -> None:
    text = unobservable.summary()
    assert "unobservable" in text.splitlines()[0]
    assert "gains along +0.71 gains[0] -0.71 gains[1]: nothing informs it" in text.replace(
        "-0.71 gains[1] +0.71 gains[0]", "+0.71 gains[0] -0.71 gains[1]"
    ).replace("+0.71 gains[1] -0.71 gains[0]", "+0.71 gains[0] -0.71 gains[1]")
    assert [line.split()[-1] for line in text.splitlines() if line.startswith("  gains[")] == ["inf", "inf"]
    assert any(line.split() == ["bias", "0.5", "+-", "0.2", "m/s^2"] for line in text.splitlines())


def test_long_problems_are_cut_in_print(rng: np.random.Generator) -> None:
    problem = LeastSquares([Variable("x", 90)], [Term("rows", 90, ("x",))])
    problem.set_term("rows", {"x": np.eye(90)}, rng.normal(size=90))
    lines = solve(problem).summary().splitlines()
    assert len(lines) < 60
    assert any("and 50 more components" in line for line in lines)


# ---- covariances and observability ------------------------------------------------------------------------------


def test_readouts(covariance: np.ndarray, rng: np.random.Generator) -> None:
    estimate = handmade(covariance)
    matrix = rng.normal(size=(2, 12))
    np.testing.assert_allclose(
        estimate.readout_covariance(matrix), matrix @ covariance @ matrix.T, rtol=1e-12
    )
    np.testing.assert_allclose(estimate.sd("lever arm"), np.sqrt(np.diag(covariance)[3:6]))
    with pytest.raises(InputError, match="12 columns"):
        estimate.readout_covariance(np.ones((1, 5)))
    with pytest.raises(InputError, match="rotation, lever arm, pose"):
        estimate.covariance("arm")


def test_a_readout_of_what_is_known_survives_what_is_not(unobservable: Estimate) -> None:
    assert unobservable.readout_covariance(np.array([[1.0, 1.0, 0.0]]))[0, 0] == pytest.approx(1.0)
    assert np.isnan(unobservable.readout_covariance(np.array([[1.0, 0.0, 0.0]]))[0, 0])
    assert np.all(np.isnan(unobservable.sd("gains")))


def test_observability_separates_what_nothing_informs_from_what_is_weak() -> None:
    variables = [Variable("arm", 3, unit="m", resolution=0.1), Variable("free", 2)]
    null = {"arm": np.array([[0.0], [0.0], [1.0]]), "free": np.array([[0.6], [0.8]])}
    found = observe(variables, lambda name: np.diag([0.01, 4e-4, 777.0]), advice="move", null=null)
    assert [d.variable for d in found.missing] == ["arm", "free"] or [d.variable for d in found.missing] == [
        "free",
        "arm",
    ]
    assert all(d.sd == np.inf for d in found.missing)
    assert found.advice == "move"
    known = [d for d in found.directions if d.observable]
    assert [round(d.sd, 6) for d in known] == [0.1, 0.02]
    np.testing.assert_allclose(np.abs(known[0].vector), [1.0, 0.0, 0.0], atol=1e-12)
    assert observe(variables[:1], lambda name: 1e-6 * np.eye(3), advice="move").advice == ""


def test_words_of_a_direction() -> None:
    variable = Variable("x", 100)
    spread = default_words(variable, np.full(100, 0.1))
    assert spread.endswith("...")
    assert spread.count("+0.10") == 3
    assert (
        default_words(Variable("arm", 2, components=("x", "y")), np.array([0.6, -0.8]))
        == "arm along -0.80 y +0.60 x"
    )


# ---- provenance and import --------------------------------------------------------------------------------------


def test_problem_hash_tells_problems_apart(rng: np.random.Generator) -> None:
    A, b = rng.normal(size=(4, 2)), rng.normal(size=4)

    def make(
        b: np.ndarray = b, variance: float = 1.0, bound: float = np.inf, loss: Huber | None = None
    ) -> str:
        problem = LeastSquares(
            [Variable("x", 2)], [Term("rows", 4, ("x",), Covariance.scalar(variance), loss)]
        )
        problem.set_term("rows", {"x": A}, b)
        problem.set_bounds("x", -np.inf, bound)
        return problem_hash("kind", problem)

    assert make() == make()
    assert (
        len(
            {
                make(),
                make(b + 1e-15),
                make(variance=2.0),
                make(bound=1.0),
                make(loss=Huber()),
                make(loss=Huber(2.0)),
            }
        )
        == 6
    )


def test_versions_name_what_computed() -> None:
    found = versions(("qdldl", "no_such_module"))
    assert found["numpy"] == np.__version__
    assert found["factorgrasp"] == factorgrasp.__version__
    assert "qdldl" in found
    assert "no_such_module" not in found


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, factorgrasp; before = set(sys.modules);"
        "heavy = {'gtsam', 'pinocchio', 'casadi', 'osqp', 'matplotlib', 'pandas', 'numba', 'scipy', 'qpsolvers'};"
        "assert not heavy & before, heavy & before;"
        "from factorgrasp import solve, Estimate;"
        "heavy -= {'scipy'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules);"
        "assert set(factorgrasp.__all__) <= set(dir(factorgrasp))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(factorgrasp.__file__).parents[1])


def test_lazy_names_resolve() -> None:
    for name in factorgrasp.__all__:
        assert getattr(factorgrasp, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = factorgrasp.nonsense
