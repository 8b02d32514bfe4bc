"""Measuring solvers alike: what a run was made on, and cold and warm times of one problem."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from factorgrasp.solvers.base import Solution
from factorgrasp.status import Status


@dataclass(frozen=True)
class Timing:
    """Medians over the repeats, in seconds.

    Attributes
    ----------
    setup : float
        Cold: what comes before the iterations when nothing is cached (conversion, analysis, factorisation where a backend does it then).
    solve : float
        Cold: the iterations.
    warm : float
        Everything again for values of the same pattern with the last solution as a start: set-up or update, and iterations.
    repeats : int
    """

    setup: float
    solve: float
    warm: float
    repeats: int

    @property
    def cold(self) -> float:
        """Set-up and solve together."""
        return self.setup + self.solve


Solve = Callable[[Solution | None], Solution]
"""Solves one problem, from a start or from nothing."""


def measure(
    fresh: Callable[[], Solve], repeat: int, budget: float = 1.0
) -> tuple[Solution, Timing, Solution]:
    """Solve one problem cold and warm, several times.

    Parameters
    ----------
    fresh : callable
        A solver with nothing cached, as a function of the start.
    repeat : int
        Repeats of each; fewer when `budget` seconds are used up.
    budget : float

    Returns
    -------
    cold : Solution
    timing : Timing
    warm : Solution
        Of the last warm solve.
    """
    began = time.perf_counter()
    cold_times, setup_times, warm_times = [], [], []
    run = fresh()
    # The first run loads libraries: it is kept as the answer and not as a time.
    answer = last = run(None)
    done = 0
    while done < max(repeat, 1) and (done == 0 or time.perf_counter() - began < budget):
        run = fresh()
        answer = run(None)
        setup_times.append(answer.setup_time)
        cold_times.append(answer.solve_time)
        start = time.perf_counter()
        last = run(answer if answer.status is Status.SOLVED else None)
        warm_times.append(time.perf_counter() - start)
        done += 1
    timing = Timing(
        float(np.median(setup_times)), float(np.median(cold_times)), float(np.median(warm_times)), done
    )
    return answer, timing, last


def environment(packages: Iterable[str]) -> dict[str, str]:
    """What a run was made on: processor, cores, thread limit, Python, and the versions of the packages that are there."""
    out = {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "not set"),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for package in packages:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            continue
    return out


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"
