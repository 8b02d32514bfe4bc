"""Draw the figures of docs/excitation-loop.md afresh: the same seed gives the same pictures.

python docs/make_excitation_loop_figures.py [--out docs/figures] [--seed 0]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from factorgrasp.models.arm import default_arm
from factorgrasp.motion_scene import MotionScene, strip
from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop
from factorgrasp.simulation.grasp_loop_figures import (
    PAPER_ESTIMATE,
    draw_convergence,
    draw_fig5,
    reproduce_fig5,
    spring_force,
)

SECONDS = 20.0


def main(arguments: list[str] | None = None) -> None:
    """Draw all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures", help="their folder")
    parser.add_argument("--seed", type=int, default=0, help="of noise and biases")
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)

    fig5 = reproduce_fig5()
    draw_fig5(fig5, chosen.out / "excitation_loop_fig5.png")
    for name in ("biased", "stiff", "estimated", "true"):
        run = getattr(fig5, name)
        low, high = run.wrench[:, :3].min(axis=0), run.wrench[:, :3].max(axis=0)
        ranges = ", ".join(f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True))
        print(
            f"{name}: peak {run.felt().peak_force:.2f} N, RMS {run.felt().rms_force:.2f} N; x, y, z {ranges} N"
        )
    for label, lever in (("biased", (0.5, 0.0, 0.0)), ("estimated", PAPER_ESTIMATE)):
        peak, mean = spring_force(lever, 150.0)
        print(f"springs of 300 N/m in series, {label}: peak {peak:.1f} N, mean {mean:.1f} N")

    ours = cehajic2015_loop(chosen.seed, duration=SECONDS)
    runs = {
        "receding plan (arm)": ours,
        "paper: law (26), its estimate": cehajic2015_loop(
            chosen.seed, duration=SECONDS, policy="velocity", arm=False
        ),
        "law (26), our estimate": cehajic2015_loop(chosen.seed, duration=SECONDS, policy="velocity_online"),
    }
    draw_convergence(runs, chosen.out / "excitation_loop_convergence.png")
    for label, run in runs.items():
        felt, late = run.felt(), run.felt(SECONDS - 5.0)
        print(
            f"{label}: {np.degrees(run.rotation_error[-1]):.3f} deg, {1e3 * run.translation_error[-1]:.2f} mm; peak "
            f"{felt.peak_force:.2f} N, RMS {felt.rms_force:.2f} N, of the last 5 s {late.rms_force:.3f} N"
        )
    assert ours.joints is not None
    arm = default_arm()
    scene = MotionScene.of_joints(
        ours.t[::10], ours.joints[::10], arm.model, arm.frame, ours.truth.translation, ours.wrench[::10, :3]
    )
    strip(scene, chosen.out / "excitation_loop_strip.png", (0.0, 1.4, 4.4, 5.4, 18.0))


if __name__ == "__main__":
    main()
