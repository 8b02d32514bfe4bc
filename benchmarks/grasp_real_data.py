"""GraspPose on public recordings: optical capture, a drone, an industrial robot. What is absent is skipped, with the reason."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grasp_filtered_first as filtered_first
import numpy as np
from grasp_recordings import (
    SHIFT,
    TURN,
    apart,
    carried,
    halves,
    moved_body,
    read_abb,
    read_broad,
    read_euroc,
    sigmas,
    transforms,
)
from metrics import Metric

from factorgrasp import lie, solve
from factorgrasp.problems import GraspPose
from factorgrasp.tables import Column, Table

GRAVITY = np.array((0.0, 0.0, -9.80665))
FILTER_HZ = 10.0
BROAD = (
    "06_undisturbed_fast_rotation_A",
    "07_undisturbed_fast_rotation_B",
    "16_undisturbed_fast_translation_B",
    "21_undisturbed_fast_combined",
)
# The letter in a name stands for a mounting: over the whole set of trials the lever arms cluster by it, and 21 lies with B.
ONE_MOUNTING = BROAD[1:]
ABB = (
    "V_300_Sequencia1",
    "V_300_Sequencia4",
    "V_500_Sequencia1",
    "V_500_Sequencia4",
    "V_800_Sequencia1",
    "eV50p_Sequencia1",
)


@dataclass(frozen=True)
class Section:
    """What one collection of recordings yields; `skipped` says why it yields nothing or less."""

    tables: tuple[Table, ...] = ()
    metrics: tuple[Metric, ...] = ()
    skipped: str = ""


def measure(folder: Path, directions: int, say: Callable[[str], None]) -> list[Section]:
    """All collections below the data folder; `directions` rigid transforms move every body."""
    sections = []
    for name, section in (("broad", broad), ("euroc_v102", euroc), ("abb_imu_robot", abb)):
        if (folder / name).is_dir():
            sections.append(section(folder / name, directions))
            say(f"real data: {name}")
        else:
            sections.append(Section(skipped=f"{name}: not in the data folder {folder}"))
    return sections


def broad(folder: Path, directions: int) -> Section:
    """Optical poses and an IMU on one body: the relative rotation is the identity."""
    found: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    missing = [trial for trial in BROAD if not (folder / f"{trial}.npz").is_file()]
    for trial in BROAD:
        if trial not in missing:
            found[trial], row = broad_trial(folder / f"{trial}.npz", directions)
            rows.append(row)
    if not rows:
        return Section(skipped=f"broad: none of {', '.join(BROAD)} in {folder}")

    def worst(key: str, scale: float = 1.0) -> float:
        return scale * max(row[key] for row in rows)

    usual = [1e3 * row["usual_moved"] for row in rows]
    offsets = [1e3 * row["offset"] for row in rows]
    note = f"{directions} rigid transforms of {SHIFT} m and {TURN} rad a trial"
    usual_note = f"{min(usual):.2g} to {max(usual):.2g} mm over the trials, cut-off {FILTER_HZ:g} Hz"
    metrics = [
        Metric("broad, rotation to the identity, worst", worst("rotation", _DEGREES), "deg", "lower", 0.4),
        Metric("broad, moved body, translation, worst", worst("moved", 1e3), "mm", "lower", 1.0, note),
        Metric("broad, moved body, rotation, worst", worst("turned", _DEGREES), "deg", "lower", 0.05, note),
        Metric("broad, moved body, signals filtered first, worst", max(usual), "mm", note=usual_note),
        Metric("broad, halves of a trial, worst component", worst("halves"), "sigma", "lower", 3.0),
        Metric("broad, time offset, least", min(offsets), "ms", "within", (3.5, 4.7)),
        Metric("broad, time offset, largest", max(offsets), "ms", "within", (3.5, 4.7)),
    ]
    same = [found[trial] for trial in ONE_MOUNTING if trial in found]
    pairs = list(itertools.combinations(same, 2))
    if pairs:
        distance = 1e3 * max(float(np.linalg.norm(a.translation - b.translation)) for a, b in pairs)
        deviation = max(float(sigmas(a, b)[3:].max()) for a, b in pairs)
        note = "mounting B: trials 07, 16, 21"
        metrics += [
            Metric("broad, lever arms of one mounting apart, worst", distance, "mm", note=note),
            Metric(
                "broad, lever arms of one mounting, worst component", deviation, "sigma", "lower", 3.0, note
            ),
        ]
    table = Table(BROAD_COLUMNS, tuple(rows), "broad: optical poses and IMU, four trials of 60 s")
    skipped = f"broad: {', '.join(missing)} not in {folder}" if missing else ""
    return Section((table,), tuple(metrics), skipped)


def broad_trial(path: Path, directions: int) -> tuple[Any, dict[str, Any]]:
    """Estimate and table row of one trial."""
    robot, hand = read_broad(path)
    plain = solve(GraspPose(robot, hand))
    tau, grasp = plain.time_offset, (plain.rotation, plain.translation)
    usual = filtered_first.estimate(robot, hand, FILTER_HZ, tau, GRAVITY)
    ours, theirs = [], []
    for shift, turn in transforms(directions):
        body = moved_body(robot, shift, turn)
        after = solve(GraspPose(body, hand))
        ours.append(apart((after.rotation, after.translation), carried(grasp, shift, turn)))
        usual_after = filtered_first.estimate(body, hand, FILTER_HZ, tau, GRAVITY)
        theirs.append(apart(usual_after, carried(usual, shift, turn)))
    first, second = (solve(GraspPose(*half)) for half in halves(robot, hand))
    row = {
        "trial": path.stem,
        "status": plain.status.value,
        "rotation": float(lie.angle_between(plain.rotation, np.eye(3))),
        **dict(zip("xyz", plain.translation.tolist(), strict=True)),
        "sd": float(np.sqrt(np.diag(plain.covariance)[3:].max())),
        "offset": tau,
        "moved": max(distance for _, distance in ours),
        "turned": max(angle for angle, _ in ours),
        "usual_moved": max(distance for _, distance in theirs),
        "usual_turned": max(angle for angle, _ in theirs),
        "halves": float(sigmas(first, second).max()),
        "halves_apart": float(np.linalg.norm(first.translation - second.translation)),
    }
    return plain, row


def euroc(folder: Path, directions: int) -> Section:
    """A drone's ground-truth poses, expressed in the IMU's own frame: the truth is the identity and zero."""
    robot, hand, biases = read_euroc(folder)
    plain = solve(GraspPose(robot, hand))
    sd = np.sqrt(np.diag(plain.covariance))
    error = np.concatenate([lie.so3_log(plain.rotation), plain.translation])
    ours = []
    for shift, turn in transforms(directions):
        after = solve(GraspPose(moved_body(robot, shift, turn), hand))
        expected = carried((plain.rotation, plain.translation), shift, turn)
        ours.append(apart((after.rotation, after.translation), expected))
    # The published biases come from the data set's own filter: they wander, and their mean is what a constant can meet.
    gyro = plain.gyro_bias - biases[:, :3].mean(axis=0)
    accelerometer = plain.accelerometer_bias - biases[:, 3:].mean(axis=0)
    moved, turned = 1e3 * max(distance for _, distance in ours), _DEGREES * max(angle for angle, _ in ours)
    note = f"{directions} rigid transforms of {SHIFT} m and {TURN} rad"
    gyro_note, accelerometer_note = (
        f"worst component {np.max(np.abs(off) / claimed):.1f} sigma"
        for off, claimed in ((gyro, plain.gyro_bias_sd), (accelerometer, plain.accelerometer_bias_sd))
    )
    turn_off, arm_off = _DEGREES * np.linalg.norm(error[:3]), 1e3 * np.linalg.norm(error[3:])
    turn_sigma, arm_sigma = (np.max(np.abs(error[part]) / sd[part]) for part in (slice(0, 3), slice(3, 6)))
    fused = "the ground truth is itself a fusion of this IMU with Vicon"
    metrics = (
        Metric("euroc, rotation error", turn_off, "deg", "lower", 0.4, "truth: the identity"),
        Metric("euroc, rotation error, worst component", turn_sigma, "sigma", note=fused),
        Metric("euroc, lever arm error", arm_off, "mm", "lower", 5.0, "truth: zero; weak excitation"),
        Metric("euroc, lever arm error, worst component", arm_sigma, "sigma", "lower", 3.0),
        Metric("euroc, moved body, translation, worst", moved, "mm", "lower", 1.0, note),
        Metric("euroc, moved body, rotation, worst", turned, "deg", "lower", 0.05, note),
        Metric(
            "euroc, gyroscope bias off the published",
            np.linalg.norm(gyro),
            "rad/s",
            "lower",
            1.5e-3,
            gyro_note,
        ),
        Metric(
            "euroc, accelerometer bias off the published",
            np.linalg.norm(accelerometer),
            "m/s^2",
            "lower",
            0.03,
            accelerometer_note,
        ),
    )
    return Section((), metrics)


def abb(folder: Path, directions: int) -> Section:
    """An industrial robot with poses of 15 Hz, interpolated: rotation and lag can be seen, the lever arm cannot."""
    rows, found = [], []
    for name in ABB:
        path = folder / f"MPU9150_{name}.csv"
        if not path.is_file():
            continue
        plain = solve(GraspPose(*read_abb(path)))
        found.append(plain)
        sd = np.sqrt(np.diag(plain.covariance))
        directions_missing = () if plain.observability is None else plain.observability.missing
        rows.append({
            "file": name,
            "status": plain.status.value,
            "rotation": float(lie.angle_between(plain.rotation, np.eye(3))),
            "rotation_sd": float(sd[:3].max()),
            "offset": plain.time_offset,
            "offset_sd": plain.time_offset_sd,
            "z": float(plain.translation[2]),
            "z_sd": float(sd[5]),
            "least_sd": float(sd[3:].min()),
            "flagged": any(direction.variable == "translation" for direction in directions_missing),
        })  # fmt: skip
    if not rows:
        return Section(skipped=f"abb_imu_robot: none of its files in {folder}")
    pairs = list(itertools.combinations(found, 2))
    angle = _DEGREES * max(
        (float(lie.angle_between(a.rotation, b.rotation)) for a, b in pairs), default=np.nan
    )
    deviation = max((float(sigmas(a, b)[:3].max()) for a, b in pairs), default=np.nan)
    lags = [1e3 * row["offset"] for row in rows]
    flagged = float(np.mean([row["flagged"] for row in rows]))
    least = 1e3 * min(row["least_sd"] for row in rows)
    metrics = (
        Metric("abb, lag, median", float(np.median(lags)), "ms", "within", (80.0, 90.0)),
        Metric("abb, lag, least", min(lags), "ms", "within", (73.0, 97.0)),
        Metric("abb, lag, largest", max(lags), "ms", "within", (73.0, 97.0)),
        Metric("abb, rotations of the files apart, worst", angle, "deg", note="speeds 150 to 800 mm/s"),
        Metric("abb, rotations of the files, worst component", deviation, "sigma", "lower", 3.0),
        Metric("abb, lever arm flagged as not identified", flagged, "of the files", "higher", 1.0),
        Metric(
            "abb, least sd of a lever arm",
            least,
            "mm",
            "higher",
            30.0,
            "no small sigma where nothing can be seen",
        ),
    )
    table = Table(ABB_COLUMNS, tuple(rows), "abb_imu_robot: interpolated robot poses and IMU")
    return Section((table,), metrics)


_DEGREES = 180.0 / np.pi
BROAD_COLUMNS = (
    Column("trial"),
    Column("status"),
    Column("rotation", "to identity", "deg", ".3f", _DEGREES),
    Column("x", "x", "mm", ".2f", 1e3),
    Column("y", "y", "mm", ".2f", 1e3),
    Column("z", "z", "mm", ".2f", 1e3),
    Column("sd", "largest sd", "mm", ".2f", 1e3),
    Column("offset", "time offset", "ms", ".3f", 1e3),
    Column("moved", "moved body", "mm", ".3f", 1e3),
    Column("turned", "moved body", "deg", ".5f", _DEGREES),
    Column("usual_moved", "filtered first", "mm", ".2f", 1e3),
    Column("usual_turned", "filtered first", "deg", ".3f", _DEGREES),
    Column("halves", "halves", "sigma", ".2f"),
    Column("halves_apart", "halves", "mm", ".2f", 1e3),
)
ABB_COLUMNS = (
    Column("file"),
    Column("status"),
    Column("rotation", "rotation", "deg", ".2f", _DEGREES),
    Column("rotation_sd", "largest sd", "deg", ".2f", _DEGREES),
    Column("offset", "lag", "ms", ".1f", 1e3),
    Column("offset_sd", "sd", "ms", ".1f", 1e3),
    Column("z", "lever arm z", "mm", ".1f", 1e3),
    Column("z_sd", "sd", "mm", ".1f", 1e3),
    Column("flagged", "flagged"),
)
