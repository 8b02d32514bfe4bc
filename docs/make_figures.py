"""Draw the figures of docs/ afresh, from simulations only: the same seed gives the same pictures.

python docs/make_figures.py [--out docs/figures] [--seed 0]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import plots, solve
from factorgrasp.lie import skew
from factorgrasp.problems import GraspPose
from factorgrasp.simulation.cehajic2015 import PRINTED_RATE, TRANSLATION, cehajic2015
from factorgrasp.simulation.cehajic2015_figures import (
    MOTIONS,
    Motion,
    draw_fig4,
    excitation_gramian,
    reproduce_fig4,
)
from factorgrasp.simulation.grasp import GraspRecording
from factorgrasp.simulation.trajectory import RigidMotion
from factorgrasp.typing import FloatArray

PREFIXES = np.arange(2.0, 60.1, 2.0)
LABEL = "factorgrasp, on the data so far"
TITLES: dict[Motion, str] = {"printed": "printed motion", "exciting": "exciting motion"}
COLOURS: dict[Motion, str] = {"printed": plots.PALETTE["x"], "exciting": plots.PALETTE["y"]}
AXIS = PRINTED_RATE / np.linalg.norm(PRINTED_RATE)


@dataclass(frozen=True, eq=False)
class Prefixes:
    """Estimates from the first seconds of a recording.

    Attributes
    ----------
    t : ndarray, shape (k,)
        Length of what was used, s.
    rotation_wxyz, translation : ndarray, shape (k, 4) and (k, 3)
    covariance : ndarray, shape (k, 6, 6)
    status : tuple of str
    """

    t: FloatArray
    rotation_wxyz: FloatArray
    translation: FloatArray
    covariance: FloatArray
    status: tuple[str, ...]


def estimate_prefixes(recording: GraspRecording) -> Prefixes:
    """GraspPose with its defaults on growing parts of a recording."""
    found: list[Any] = []
    for end in PREFIXES:
        problem = GraspPose(recording.robot.slice(0.0, end), recording.hand.slice(0.0, end))
        found.append(solve(problem))
    return Prefixes(
        PREFIXES,
        np.array([f.rotation_wxyz for f in found]),
        np.array([f.translation for f in found]),
        np.array([f.covariance for f in found]),
        tuple(f.status.value for f in found),
    )


def gramian_over_time(motion: RigidMotion) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (k, 3), ascending, of ``integral phi' phi dt`` from the start to times (k,)."""
    w = skew(motion.angular_velocity)
    phi = skew(motion.angular_acceleration) + w @ w
    step = motion.t[1] - motion.t[0]
    summed = np.cumsum(np.einsum("nji,njk->nik", phi, phi), axis=0) * step
    every = slice(99, None, 100)
    return motion.t[every], np.linalg.eigvalsh(summed[every])


@plots.styled
def draw_observability(
    prefixes: dict[Motion, Prefixes], recordings: dict[Motion, GraspRecording], path: Path
) -> None:
    """Three panels: excitation of a sample, excitation so far, and what is known of the lever arm."""
    made, (instant, gramian, known) = plots.figure(10.5, 3.9, 1, 3)
    for motion in MOTIONS:
        truth, colour = recordings[motion].robot_truth, COLOURS[motion]
        cross = np.cross(truth.angular_velocity, truth.angular_acceleration)
        early = slice(0, 12000, 10)
        instant.plot(
            truth.t[early], np.einsum("ni,ni->n", cross, cross)[early], color=colour, label=TITLES[motion]
        )
        t, eigenvalues = gramian_over_time(truth)
        for k, style in enumerate((":", "--", "-")):
            gramian.plot(t, np.maximum(eigenvalues[:, k], 1e-16), style, color=colour)
    instant.set_title("one sample: $-\\det\\,\\varphi = |\\omega \\times \\alpha|^2$")
    instant.set(xlabel="time [s]", ylabel="rad$^6$/s$^6$", ylim=(-0.1, 5.0))
    instant.legend(loc="upper right", ncols=2)
    gramian.set_title("so far: eigenvalues of $\\int\\varphi^T\\varphi\\,dt$")
    gramian.set(xlabel="time [s]", ylabel="s$^{-3}$", yscale="log")
    gramian.text(
        30.0, 1e-11, "printed, along its axis:\nrounding only", color=COLOURS["printed"], ha="center"
    )

    for motion in MOTIONS:
        part, colour = prefixes[motion], COLOURS[motion]
        arm = part.covariance[:, 3:, 3:]
        across = np.eye(3) - np.outer(AXIS, AXIS)
        along = np.sqrt(np.einsum("i,kij,j->k", AXIS, arm, AXIS))
        worst_across = np.sqrt(np.linalg.eigvalsh(across @ arm @ across)[:, 2])
        error = np.abs((part.translation - TRANSLATION) @ AXIS)
        known.plot(part.t, along, color=colour)
        known.plot(part.t, error, "o", color=colour, markersize=2.5)
        known.plot(part.t, worst_across, "--", color=colour)
    for style, label in (
        ("-", "claimed sd along the axis"),
        ("o", "true error along it"),
        ("--", "claimed sd across it"),
    ):
        known.plot([], [], style, color=plots.PALETTE["muted"], markersize=2.5, label=label)
    known.set_title("lever arm, by direction from the printed axis")
    known.set(xlabel="length of the recording [s]", ylabel="m", yscale="log", ylim=(1e-5, 1e3))
    known.legend(loc="upper right")
    made.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> None:
    """Draw all figures and print the numbers that docs/grasp_observability.md quotes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "figures", help="folder of the pictures"
    )
    parser.add_argument("--seed", type=int, default=0, help="of noise and biases")
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)

    recordings = {motion: cehajic2015(chosen.seed, motion=motion) for motion in MOTIONS}
    prefixes = {motion: estimate_prefixes(recording) for motion, recording in recordings.items()}

    def history(recording: GraspRecording) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        part = next(prefixes[motion] for motion in MOTIONS if motion in recording.name)
        return part.t, part.rotation_wxyz, part.translation, part.covariance

    found = solve(GraspPose(recordings["exciting"].robot, recordings["exciting"].hand))
    found.plot(chosen.out / "grasp.png")
    data = reproduce_fig4(seed=chosen.seed, extra_curves={LABEL: history})
    draw_fig4(data, chosen.out / "grasp_fig4.png")
    draw_observability(prefixes, recordings, chosen.out / "grasp_observability.png")

    for motion in MOTIONS:
        eigenvalues = np.linalg.eigvalsh(excitation_gramian(recordings[motion].robot_truth))
        print(f"{TITLES[motion]}: eigenvalues {', '.join(f'{value:.3g}' for value in eigenvalues)} s^-3")
        for label, curve in data.curves[motion].items():
            print(
                f"  {label}: {np.rad2deg(curve.angle[-1]):.3g} deg, {1e3 * curve.translation_norm[-1]:.3g} mm, {curve.status}"
            )
        part = prefixes[motion]
        sd = np.sqrt(np.linalg.eigvalsh(part.covariance[-1, 3:, 3:]))
        along = float((part.translation[-1] - TRANSLATION) @ AXIS)
        print(
            f"  claimed sd of the lever arm: {', '.join(f'{1e3 * value:.3g}' for value in sd)} mm; {part.status[-1]}"
        )
        print(f"  error along the printed axis: {1e3 * along:.3g} mm")


if __name__ == "__main__":
    main()
