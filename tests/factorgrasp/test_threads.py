"""The number of BLAS threads inside a solve."""

from __future__ import annotations

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from factorgrasp.threads import CHOSEN_BY, one_blas_thread


def threads() -> dict[str, int]:
    """By library: some of other packages, loaded meanwhile, are built for one thread only."""
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_inside_and_as_many_as_before_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in CHOSEN_BY:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert 2 in before.values()
        with one_blas_thread():
            inside = threads()
        assert all(inside[path] == 1 for path in before if "numpy" in path or "scipy" in path)
        assert threads() == before


def test_what_the_user_chose_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with one_blas_thread():
            assert threads() == before
