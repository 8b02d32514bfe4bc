"""What an estimate costs: a minute of 1 kHz data in one batch, beside the paper's recursion on the same data in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from metrics import Metric

from factorgrasp import solve
from factorgrasp.baselines.cehajic2015 import CehajicRecursion
from factorgrasp.problems import GraspPose, GraspSettings
from factorgrasp.simulation.cehajic2015 import ENCODER_POSES, cehajic2015, paper_inputs
from factorgrasp.tables import Column, Table

PAPER_SAMPLES = 10_000


@dataclass(frozen=True)
class Seconds:
    """Median and best wall time of one call over the repeats, and median processor time, which other work on the machine hardly moves."""

    median: float
    best: float
    processor: float


def timed(call: Callable[[], object], repeat: int) -> Seconds:
    """Time a call; the first run, which loads libraries and fills caches, does not count."""
    call()
    wall, processor = [], []
    for _ in range(repeat):
        started, busy = time.perf_counter(), time.process_time()
        call()
        processor.append(time.process_time() - busy)
        wall.append(time.perf_counter() - started)
    return Seconds(float(np.median(wall)), min(wall), float(np.median(processor)))


def measure(repeat: int) -> tuple[Table, list[Metric]]:
    """Batches of 60 s with the robot side as motion and as poses, and the recursion of the paper."""
    motion, poses = cehajic2015(0), cehajic2015(0, robot=ENCODER_POSES)
    samples = len(motion.hand)
    plain = GraspSettings(time_offset=False, sensor_errors="never")

    def batch(recording: object, settings: GraspSettings | None = None) -> Callable[[], object]:
        return lambda: solve(GraspPose(recording.robot, recording.hand, settings=settings))  # type: ignore[attr-defined]

    calls = {
        "motion": ("60 s of 1 kHz, robot side as motion, default settings", batch(motion)),
        "motion, plain": ("the same without time offset and sensor errors", batch(motion, plain)),
        "poses": ("60 s of 1 kHz, robot side as poses, default settings", batch(poses)),
    }
    rows, seconds = [], {}
    for key, (words, call) in calls.items():
        seconds[key] = timed(call, repeat)
        rows.append(_row(words, seconds[key], samples))

    inputs = paper_inputs(motion)
    signals = (
        inputs.robot_angular_velocity,
        inputs.robot_angular_acceleration,
        inputs.robot_acceleration,
        inputs.hand_angular_velocity,
        inputs.hand_acceleration,
    )
    part = list(zip(*(signal[:PAPER_SAMPLES] for signal in signals), strict=True))

    def recursion() -> None:
        estimator = CehajicRecursion(1e-3)
        for sample in part:
            estimator.update(*sample)

    paper = timed(recursion, max(3, repeat // 3))
    rows.append(_row(f"the paper's recursion, {PAPER_SAMPLES} samples", paper, PAPER_SAMPLES))
    ratio = (paper.processor / PAPER_SAMPLES) / (seconds["motion"].processor / samples)
    metrics = []
    for key, words in (("motion", "motion stream"), ("poses", "pose stream")):
        spent = seconds[key]
        note = f"after loading, one thread; wall time median {1e3 * spent.median:.0f}, best {1e3 * spent.best:.0f} ms"
        metrics.append(
            Metric(f"60 s batch, {words}, processor time", 1e3 * spent.processor, "ms", "lower", 50, note)
        )
    metrics += [
        Metric(
            "processor time a sample, batch", 1e6 * seconds["motion"].processor / samples, "us", "lower", 25
        ),
        Metric("processor time a sample, paper's recursion", 1e6 * paper.processor / PAPER_SAMPLES, "us"),
        Metric("paper's recursion over batch", ratio, "times", note="processor time a sample, same run"),
    ]
    return Table(COLUMNS, tuple(rows), "Cost, one thread"), metrics


def _row(words: str, seconds: Seconds, samples: int) -> dict[str, object]:
    return {
        "what": words,
        "median": seconds.median,
        "best": seconds.best,
        "processor": seconds.processor,
        "sample": seconds.processor / samples,
    }


COLUMNS = (
    Column("what"),
    Column("median", "wall, median", "ms", ".3g", 1e3),
    Column("best", "wall, best", "ms", ".3g", 1e3),
    Column("processor", "processor, median", "ms", ".3g", 1e3),
    Column("sample", "processor a sample", "us", ".3g", 1e6),
)
