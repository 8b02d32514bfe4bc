"""Covariances against linear algebra by hand, and the consistency measures against chi-square sampling."""

from __future__ import annotations

import numpy as np
import pytest

from factorgrasp.errors import FactorgraspError, InputError
from factorgrasp.uncertainty import Covariance, nees, nees_band


def random_spd(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def test_scalar_and_diagonal_roots() -> None:
    np.testing.assert_allclose(Covariance.scalar(4.0).rows_root(3), [0.5, 0.5, 0.5])
    np.testing.assert_allclose(Covariance.diagonal([1.0, 4.0, 0.25]).rows_root(3), [1.0, 0.5, 2.0])


def test_block_root_is_an_upper_triangular_square_root_of_the_information(rng: np.random.Generator) -> None:
    blocks = np.stack([random_spd(rng, 4) for _ in range(5)])
    root = Covariance.blocks(blocks).root
    np.testing.assert_allclose(np.tril(root, -1), 0.0, atol=1e-12)
    for W, covariance in zip(root, blocks, strict=True):
        np.testing.assert_allclose(W.T @ W, np.linalg.inv(covariance), rtol=1e-9, atol=1e-9)


def test_one_block_serves_all_rows(rng: np.random.Generator) -> None:
    covariance = Covariance.blocks(random_spd(rng, 3))
    covariance.check_rows(9, "term")
    assert covariance.rows_root(9).shape == (3, 3, 3)
    with pytest.raises(InputError, match="term"):
        covariance.check_rows(10, "term")


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_a_variance_must_be_finite_and_positive(bad: float) -> None:
    with pytest.raises(InputError, match="gyro variance"):
        Covariance.scalar(bad, "gyro variance")
    with pytest.raises(InputError, match="equality constraint"):
        Covariance.diagonal([1.0, bad])


def test_blocks_must_be_symmetric_and_positive_definite() -> None:
    with pytest.raises(InputError, match="symmetric"):
        Covariance.blocks([[1.0, 0.5], [0.0, 1.0]])
    with pytest.raises(InputError, match="smallest eigenvalue -1"):
        Covariance.blocks([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(InputError, match="shape"):
        Covariance.blocks(np.ones((2, 3)))


def test_sqrt_information_is_taken_as_it_is(rng: np.random.Generator) -> None:
    W = rng.normal(size=(2, 3, 3))
    np.testing.assert_array_equal(Covariance.sqrt_information(W).root, W)
    assert Covariance.sqrt_information(W).block_size == 3
    with pytest.raises(InputError, match="finite"):
        Covariance.sqrt_information([1.0, np.nan])


def test_errors_survive_a_process_boundary() -> None:
    import pickle

    error = pickle.loads(pickle.dumps(InputError("field", "a", "b", "hint")))
    assert isinstance(error, FactorgraspError)
    assert (error.field, error.expected, error.found, error.hint) == ("field", "a", "b", "hint")


def test_nees_of_honest_samples_lies_in_its_band(rng: np.random.Generator) -> None:
    covariance = random_spd(rng, 6)
    samples = rng.multivariate_normal(np.zeros(6), covariance, size=200)
    mean = np.mean([nees(sample, covariance) for sample in samples]) / 6.0
    low, high = nees_band(6, 200)
    assert low < mean < high
    # A covariance that claims twice the precision must fall out of the band.
    assert np.mean([nees(sample, 0.5 * covariance) for sample in samples]) / 6.0 > high


def test_nees_band_matches_the_documented_one() -> None:
    low, high = nees_band(6, 50)
    assert low == pytest.approx(0.85, abs=0.01)
    assert high == pytest.approx(1.17, abs=0.01)
