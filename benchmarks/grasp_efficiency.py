"""Root-mean-square errors over the Cramer-Rao bound where the model holds: a robot without noise.

Beside the bound stands the efficient estimator of :mod:`grasp_bound`. Its covariance is the bound, exactly, and it sees the same noise.
So the ratio of both root-mean-square errors estimates RMSE over bound without most of the Monte-Carlo scatter (a control variate): 200
seeds tell 1 % apart, where the plain ratio scatters by 3 %. The former is what the target is held against.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from grasp_bound import Bound, cramer_rao
from grasp_monte_carlo import FEWEST_SEEDS, pose_error, time_offset
from metrics import Metric

from factorgrasp import solve
from factorgrasp.problems import GraspPose
from factorgrasp.simulation.cehajic2015 import cehajic2015
from factorgrasp.simulation.grasp import RobotSensing
from factorgrasp.tables import Column, Table
from factorgrasp.typing import FloatArray

TARGET = 1.05


def run(seed: int) -> tuple[FloatArray, Bound]:
    """Error (7,) of GraspPose (rotation, lever arm, time offset) and the bound, for one seed."""
    offset = time_offset(seed)
    recording = cehajic2015(seed, robot=RobotSensing(), time_offset=offset)
    found = solve(GraspPose(recording.robot, recording.hand))
    error = pose_error(recording, found.rotation, found.translation)
    return np.append(error, found.time_offset - offset), cramer_rao(recording)


def measure(seeds: Sequence[int], workers: int) -> tuple[Table, list[Metric]]:
    """RMSE over bound for the rotation, the lever arm and the time offset."""
    with ProcessPoolExecutor(workers) as pool:
        results = list(pool.map(run, seeds, chunksize=2))
    errors = np.array([error for error, _ in results])
    efficient = np.array([bound.error for _, bound in results])
    variances = np.array([np.diag(bound.covariance) for _, bound in results])
    rows, metrics = [], []
    for name, unit, scale, ours, columns in (
        ("rotation", "deg", 180.0 / np.pi, slice(0, 3), slice(0, 3)),
        ("lever arm", "mm", 1e3, slice(3, 6), slice(3, 6)),
        ("time offset", "us", 1e6, slice(6, 7), slice(12, 13)),
    ):
        mine, best = errors[:, ours], efficient[:, columns]
        bound = float(np.sqrt(variances[:, columns].sum(axis=1).mean()))
        ratio, ratio_sd = (
            _rms(mine) / bound,
            _resampled(lambda k, a=mine, c=bound: _rms(a[k]) / c, len(seeds)),
        )
        paired, paired_sd = (
            _rms(mine) / _rms(best),
            _resampled(lambda k, a=mine, c=best: _rms(a[k]) / _rms(c[k]), len(seeds)),
        )
        rows.append({
            "unknown": f"{name} [{unit}]",
            "rmse": scale * _rms(mine),
            "bound": scale * bound,
            "ratio": ratio,
            "ratio_sd": ratio_sd,
            "efficient": scale * _rms(best),
            "paired": paired,
            "paired_sd": paired_sd,
        })  # fmt: skip
        if name == "time offset":
            continue
        count = f"{len(seeds)} seeds"
        words = f"{count}, sampling sd {paired_sd:.3f}; the bound by the errors of the efficient estimator on the same noise"
        plain_words = f"{count}, sampling sd {ratio_sd:.3f}"
        metrics += [
            Metric(f"RMSE / Cramer-Rao bound, {name}", paired, "", "lower", TARGET, words),
            Metric(f"RMSE / Cramer-Rao bound, {name}, plain", ratio, note=plain_words),
        ]
    if len(seeds) < FEWEST_SEEDS:
        metrics = [m.without_target("too few seeds to judge") for m in metrics]
    table = Table(COLUMNS, tuple(rows), "Against the Cramer-Rao bound, exciting motion, robot without noise")
    return table, metrics


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1))))


def _resampled(statistic, count: int, rounds: int = 400) -> float:  # type: ignore[no-untyped-def]
    """Standard deviation of a statistic over seeds drawn with replacement."""
    rng = np.random.default_rng(0)
    return float(np.std([statistic(rng.integers(0, count, count)) for _ in range(rounds)]))


COLUMNS = (
    Column("unknown"),
    Column("rmse", "RMSE"),
    Column("bound", "bound"),
    Column("ratio", "RMSE / bound", "", ".3f"),
    Column("ratio_sd", "sampling sd", "", ".3f"),
    Column("efficient", "RMSE, efficient estimator"),
    Column("paired", "RMSE / efficient", "", ".3f"),
    Column("paired_sd", "sampling sd", "", ".3f"),
)
