"""Covariances as they enter a least-squares term, and the consistency measures of what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class Covariance:
    """Covariance of the rows of a term, held as its square-root information.

    Use the constructors :meth:`scalar`, :meth:`diagonal`, :meth:`blocks` and :meth:`sqrt_information`.

    Attributes
    ----------
    kind : {"scalar", "diagonal", "blocks"}
    root : ndarray
        Square-root information ``W`` with ``W' W = covariance^-1``: shape () for a scalar, (rows,) for a diagonal,
        (n_blocks, k, k) upper triangular for blocks of k consecutive rows.
    """

    kind: Literal["scalar", "diagonal", "blocks"]
    root: FloatArray

    @classmethod
    def scalar(cls, variance: float, field: str = "covariance") -> Covariance:
        """One variance for every row (unit of the row squared)."""
        return cls("scalar", 1.0 / np.sqrt(_positive(np.asarray(variance, dtype=float), field)))

    @classmethod
    def diagonal(cls, variances: ArrayLike, field: str = "covariance") -> Covariance:
        """One variance a row, shape (rows,)."""
        values = np.atleast_1d(np.asarray(variances, dtype=float))
        return cls("diagonal", 1.0 / np.sqrt(_positive(values, field)))

    @classmethod
    def blocks(cls, covariances: ArrayLike, field: str = "covariance") -> Covariance:
        """Full covariances of k consecutive rows each, shape (k, k) or (n_blocks, k, k).

        Raises
        ------
        InputError
            When a block is not symmetric positive definite.
        """
        values = np.asarray(covariances, dtype=float)
        values = values[None] if values.ndim == 2 else values
        if values.ndim != 3 or values.shape[1] != values.shape[2]:
            raise InputError(field, "blocks of shape (k, k) or (n, k, k)", f"shape {np.shape(covariances)}")
        if not np.allclose(values, np.swapaxes(values, 1, 2), rtol=1e-9, atol=0.0):
            raise InputError(field, "symmetric blocks", "a block that differs from its transpose")
        try:
            lower = np.linalg.cholesky(values)
        except np.linalg.LinAlgError:
            smallest = float(np.linalg.eigvalsh(values).min())
            raise InputError(
                field,
                "positive definite covariances",
                f"a singular or indefinite one (smallest eigenvalue {smallest:.3g})",
                "Give every component a variance above zero, or state an exact relation as an equality constraint",
            ) from None
        # W = L^-1 is lower triangular; its QR gives the upper-triangular root of the same information.
        inverse = np.linalg.solve(lower, np.broadcast_to(np.eye(values.shape[1]), values.shape).copy())
        return cls("blocks", np.asarray(np.linalg.qr(inverse, mode="r")))

    @classmethod
    def sqrt_information(cls, root: ArrayLike, field: str = "sqrt_information") -> Covariance:
        """From the root W itself: scalar, (rows,), (k, k) or (n_blocks, k, k)."""
        values = np.asarray(root, dtype=float)
        if not np.all(np.isfinite(values)):
            raise InputError(field, "finite numbers", "NaN or infinity")
        if values.ndim == 0:
            return cls("scalar", values)
        if values.ndim == 1:
            return cls("diagonal", values)
        return cls("blocks", values[None] if values.ndim == 2 else values)

    @property
    def block_size(self) -> int:
        """Number of consecutive rows that share one block (1 unless `kind` is "blocks")."""
        return int(self.root.shape[1]) if self.kind == "blocks" else 1

    def check_rows(self, rows: int, field: str) -> None:
        """Raise InputError unless this covariance fits `rows` rows."""
        if self.kind == "diagonal" and self.root.shape != (rows,):
            raise InputError(field, f"{rows} variances, one a row", f"{self.root.shape[0]}")
        if self.kind == "blocks":
            count, size = self.root.shape[:2]
            if count * size != rows and not (count == 1 and rows % size == 0):
                raise InputError(field, f"blocks that cover {rows} rows", f"{count} blocks of {size} rows")

    def rows_root(self, rows: int) -> FloatArray:
        """Row scales (rows,) of a scalar or diagonal covariance, or the blocks (rows / k, k, k)."""
        if self.kind == "scalar":
            return np.full(rows, float(self.root))
        if self.kind == "diagonal":
            return self.root
        return np.broadcast_to(self.root, (rows // self.block_size, *self.root.shape[1:]))


def _positive(values: FloatArray, field: str) -> FloatArray:
    if not np.all(np.isfinite(values)) or np.any(values <= 0.0):
        worst = values.flat[int(np.argmin(np.where(np.isfinite(values), values, -np.inf)))]
        raise InputError(
            field,
            "finite variances above zero",
            f"{worst:.6g}",
            "State an exact relation as an equality constraint, not as a zero variance",
        )
    return values


def nees(error: ArrayLike, covariance: ArrayLike) -> float:
    """Normalised estimation error squared, ``e' P^-1 e``; its mean is the number of components when P is honest.

    Parameters
    ----------
    error : (n,) array_like
        Estimate minus truth, in the tangent space of the covariance.
    covariance : (n, n) array_like
    """
    vector = np.asarray(error, dtype=float)
    return float(vector @ np.linalg.solve(np.asarray(covariance, dtype=float), vector))


def nees_band(dof: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean NEES per degree of freedom over `runs` independent runs (chi-square)."""
    from scipy.stats import chi2

    tail = 0.5 * (1.0 - probability)
    total = dof * runs
    return float(chi2.ppf(tail, total) / total), float(chi2.ppf(1.0 - tail, total) / total)
