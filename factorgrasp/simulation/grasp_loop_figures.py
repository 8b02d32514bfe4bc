"""Fig. 5 and Fig. 4 of Cehajic et al., IROS 2015, in closed loop: what the wrist feels, and how the estimates converge."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import excitation_plots, plots
from factorgrasp.atomic import replacing
from factorgrasp.lie import so3_exp
from factorgrasp.models.wrist import WristStiffness
from factorgrasp.simulation.cehajic2015 import PRINTED_CENTER, TRANSLATION
from factorgrasp.simulation.cehajic2015_loop import cehajic2015_loop, printed_motion
from factorgrasp.simulation.grasp_loop import GraspLoopResult
from factorgrasp.simulation.impedance import Impedance
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPER_ESTIMATE = (1.03, 0.20, 0.10)
"""``r_hat`` of the paper after a minute (m)."""
PRINTED_FORCES = {
    "biased": ((1.0, 3.0), (-3.5, 1.0), (0.0, 1.1)),
    "estimated": ((-0.6, 1.4), (-0.2, 0.5), (-0.3, 0.07)),
}
"""Ranges along x, y and z that the paper states for its Fig. 5, N."""
_POINTS = 700


@dataclass(frozen=True, eq=False)
class Fig5:
    """The force at the wrist under the printed motion, two turns of it.

    Attributes
    ----------
    biased, estimated, true : GraspLoopResult
        Turning about ``r_0``, about the paper's estimate and about the true wrist.
    stiff : GraspLoopResult
        As biased, with a robot that does not yield in rotation: the springs of both sides in series, and nothing else.
    """

    biased: GraspLoopResult
    estimated: GraspLoopResult
    true: GraspLoopResult
    stiff: GraspLoopResult


def reproduce_fig5(wrist: WristStiffness | None = None, duration: float = 4.0 * np.pi) -> Fig5:
    """Run the printed motion about three lever arms (some seconds).

    Parameters
    ----------
    wrist : WristStiffness
    duration : float
        s; the motion repeats after 2 pi.
    """

    def run(lever: tuple[float, float, float], impedance: Impedance | None = None) -> GraspLoopResult:
        return cehajic2015_loop(
            policy="fixed", lever=lever, duration=duration, arm=False, wrist=wrist, impedance=impedance
        )

    firm = Impedance(rotational_stiffness=2e4, rotational_damping=200.0)
    return Fig5(run(PRINTED_CENTER), run(PAPER_ESTIMATE), run(TRANSLATION), run(PRINTED_CENTER, firm))


def spring_force(lever: Sequence[float], stiffness: float) -> tuple[float, float]:
    """Peak and mean (over a period, N) of the force that a spring feels when the printed motion turns about `lever` instead of the wrist.

    ``stiffness |(R(t) - R_0)(r - lever)|``: what the printed numbers predict without any dynamics.

    Parameters
    ----------
    lever : (3,) sequence of float
        m.
    stiffness : float
        N/m, of robot and wrist in series.
    """
    t = np.linspace(0.0, 2.0 * np.pi, 2000)
    R = so3_exp(printed_motion().derivatives(t)[0])
    way = np.linalg.norm((R - np.eye(3)) @ (np.array(TRANSLATION) - np.asarray(lever)), axis=1)
    return stiffness * float(way.max()), stiffness * float(way.mean())


def draw_fig5(data: Fig5, path: str | os.PathLike[str]) -> None:
    """The three components of the force, one panel a lever arm."""
    made, axes = plots.figure(7.2, 6.0, rows=3, sharex=True)
    titles = (
        "Turning about the biased guess [0.5, 0, 0] m",
        "Turning about the paper's estimate [1.03, 0.20, 0.10] m",
        "Turning about the true wrist",
    )
    for ax, run, title in zip(axes, (data.biased, data.estimated, data.true), titles, strict=True):
        excitation_plots.draw_wrench(ax, run.t, run.wrench, 0, f"{title}: peak {run.felt().peak_force:.3g} N")
        ax.label_outer()
    _save(made, path)


def draw_convergence(runs: Mapping[str, GraspLoopResult], path: str | os.PathLike[str]) -> None:
    """Fig. 4 in closed loop: errors of orientation and lever arm, and the force meanwhile, for several procedures.

    Parameters
    ----------
    runs : mapping
        Label to run, at most four.
    path : path
    """
    made, axes = plots.figure(7.2, 6.2, rows=3, sharex=True)
    colours = ("z", "x", "accent", "y")
    for (label, run), colour in zip(runs.items(), colours, strict=False):
        shade = plots.PALETTE[colour]
        _line(axes[0], run.t_estimate, np.degrees(run.rotation_error), shade, label)
        _line(axes[1], run.t_estimate, 1e3 * run.translation_error, shade, label)
        every = max(1, run.t.size // _POINTS)
        # The largest force of every short stretch: a thinned line would miss peaks.
        count = run.t.size // every
        peaks = run.force[: count * every].reshape(count, every).max(axis=1)
        _line(axes[2], run.t[: count * every : every], peaks, shade, label)
        if np.isfinite(run.rotation_sd).any():
            for ax, sd in ((axes[0], np.degrees(run.rotation_sd)), (axes[1], 1e3 * run.translation_sd)):
                ax.plot(run.t_estimate, sd, color=shade, linewidth=0.8, linestyle=":")
    for ax, title, unit in zip(
        axes,
        (
            "Orientation error (dotted: stated sd)",
            "Lever arm error (dotted: stated sd)",
            "Force at the wrist",
        ),
        ("deg", "mm", "N"),
        strict=True,
    ):
        _dress(ax, title, unit)
    _label(axes[0], axes[2])
    _save(made, path)


@plots.styled
def _line(ax: Axes, t: FloatArray, values: FloatArray, colour: str, label: str) -> None:
    ax.plot(t, values, color=colour, label=label)


@plots.styled
def _dress(ax: Axes, title: str, unit: str) -> None:
    # Before the first estimate there is nothing to draw, and nothing has no logarithm.
    if any(np.any(np.asarray(line.get_ydata(), dtype=float) > 0.0) for line in ax.lines):
        ax.set_yscale("log")
    ax.set_title(title)
    ax.set_ylabel(unit)


@plots.styled
def _label(first: Axes, last: Axes) -> None:
    first.legend(ncols=3, loc="upper right")
    last.set_xlabel("time (s)")


def _save(made: Figure, path: str | os.PathLike[str]) -> None:
    file = Path(path)
    with replacing(file) as temporary:
        made.savefig(
            temporary, format=file.suffix.lstrip(".") or "png", dpi=110, facecolor=plots.PALETTE["paper"]
        )
