"""Where an estimate came from: versions of what computed it, and a hash of what was asked."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version

import numpy as np

from factorgrasp.least_squares import LeastSquares
from factorgrasp.typing import FloatArray, State


def problem_hash(kind: str, problem: LeastSquares, state: State | None = None) -> str:
    """SHA-256 (hex) of everything that decides the answer: names, patterns, values, covariances, losses, bounds and start.

    Equal problems hash alike in every process and on every machine of the same byte order.
    """
    digest = hashlib.sha256()
    words = [kind, *(f"{v.name} {v.size} {v.manifold} {v.unit} {v.resolution!r}" for v in problem.variables)]
    words += [f"{t.name} {t.rows} {t.group} {t.loss!r}" for t in problem.terms.values()]
    words += [f"{c.name} {c.rows} {c.kind}" for c in problem.constraints.values()]
    _feed_words(digest, words)
    entries, rhs = problem.whitened_values()
    pattern = problem.jacobian.matrix
    arrays: list[FloatArray] = [entries, rhs, problem.lower, problem.upper]
    for rows in (problem.equalities, problem.inequalities):
        arrays += [rows.matrix.data, rows.rhs]
        _feed_integers(digest, rows.matrix.indptr, rows.matrix.indices)
    _feed_integers(digest, pattern.indptr, pattern.indices)
    for array in arrays:
        _feed_numbers(digest, array)
    for name in sorted(state or {}):
        digest.update(name.encode())
        _feed_numbers(digest, np.asarray((state or {})[name], dtype=float))
    return digest.hexdigest()


def versions(modules: Iterable[str] = ()) -> dict[str, str]:
    """Versions of Python, factorgrasp, numpy, scipy and the distributions that provide `modules`; unknown ones are left out."""
    from factorgrasp import __version__

    out = {"python": platform.python_version(), "factorgrasp": __version__}
    for module in ("numpy", "scipy", *modules):
        found = _distribution(module)
        if found is not None:
            out[found[0]] = found[1]
    return out


@cache
def _distribution(module: str) -> tuple[str, str] | None:
    """Name and version of the distribution that provides a top-level module."""
    try:
        return module, version(module)
    except PackageNotFoundError:
        # Reading the map of all distributions takes tens of milliseconds: only where the names differ.
        found = packages_distributions().get(module)
        return (found[0], version(found[0])) if found else None


def _feed_words(digest: hashlib._Hash, words: Iterable[str]) -> None:
    digest.update("\n".join(words).encode() + b"\0")


def _feed_integers(digest: hashlib._Hash, *arrays: np.ndarray) -> None:
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=np.int64).tobytes())


def _feed_numbers(digest: hashlib._Hash, array: FloatArray) -> None:
    # Adding zero turns -0.0 into 0.0, which compare equal and must hash alike.
    digest.update(np.ascontiguousarray(array + 0.0, dtype=np.float64).tobytes())
