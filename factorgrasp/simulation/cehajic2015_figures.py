"""Fig. 4 of Cehajic et al., IROS 2015, in simulation: how the paper's estimator converges, and under which motion it can."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from factorgrasp.baselines.cehajic2015 import CehajicResult, estimate_cehajic2015
from factorgrasp.lie import angle_between, matrix_to_quaternion_wxyz, quaternion_wxyz_to_matrix, skew
from factorgrasp.simulation.cehajic2015 import cehajic2015, paper_inputs
from factorgrasp.simulation.grasp import GraspRecording
from factorgrasp.simulation.trajectory import RigidMotion
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Motion: TypeAlias = Literal["printed", "exciting"]
MOTIONS: tuple[Motion, ...] = ("printed", "exciting")

EstimateHistory: TypeAlias = (
    tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]
    | tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]
)
"""Times (k,) in s, quaternions [w, x, y, z] (k, 4) of ``R_r_h``, and ``p_r_h`` (k, 3) in m.

From an estimator that states one also its covariance (k, 6, 6), order [rotation; translation], rad and m.
"""


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """Errors of one estimator over time, as Fig. 4 defines them.

    Attributes
    ----------
    t : ndarray, shape (k,)
        s.
    quaternion_error : ndarray, shape (k, 4)
        ``|q_i - q_hat_i|`` by component [w, x, y, z], with the sign of ``q_hat`` that is nearer.
    angle : ndarray, shape (k,)
        Angle of the rotation error (rad).
    translation_error : ndarray, shape (k, 3)
        ``|r_i - r_hat_i|`` (m).
    status : str
        Of the estimator.
    quaternion_band, translation_band : ndarray, shape (k, 2), or None
        Where ``|q - q_hat|`` and ``|r - r_hat|`` (m) lie with 95 % probability if the stated covariance is right.
    """

    t: FloatArray
    quaternion_error: FloatArray
    angle: FloatArray
    translation_error: FloatArray
    status: str = "completed"
    quaternion_band: FloatArray | None = None
    translation_band: FloatArray | None = None

    @property
    def quaternion_norm(self) -> FloatArray:
        """``|q - q_hat|``, shape (k,)."""
        return np.asarray(np.linalg.norm(self.quaternion_error, axis=1))

    @property
    def translation_norm(self) -> FloatArray:
        """``|r - r_hat|`` (m), shape (k,)."""
        return np.asarray(np.linalg.norm(self.translation_error, axis=1))


@dataclass(frozen=True, eq=False)
class Fig4:
    """The data behind the figure.

    Attributes
    ----------
    recordings : dict
        Motion ("printed", "exciting") to the recording.
    curves : dict
        Motion, then label, to the errors over time.
    excitation : dict
        Motion to the eigenvalues (3,) of :func:`excitation_gramian`, ascending.
    """

    recordings: dict[Motion, GraspRecording]
    curves: dict[Motion, dict[str, ErrorCurve]]
    excitation: dict[Motion, FloatArray]


@dataclass(frozen=True, eq=False)
class FinalErrors:
    """Errors of the paper's estimator after the last sample, one entry for each seed.

    Attributes
    ----------
    angle : ndarray, shape (s,)
        rad.
    translation : ndarray, shape (s,)
        m.
    diverged : int
        How many runs did.
    """

    angle: FloatArray
    translation: FloatArray
    diverged: int


def excitation_gramian(motion: RigidMotion) -> FloatArray:
    """``integral phi' phi dt`` of eq. (23), ``phi = S(al) + S(w)^2``, over the whole motion: (3, 3), s^-3."""
    phi = skew(motion.angular_acceleration)
    w = skew(motion.angular_velocity)
    phi += w @ w
    weight = np.gradient(motion.t)
    out: FloatArray = np.einsum("n,nji,njk->ik", weight, phi, phi)
    return out


def error_curve(recording: GraspRecording, history: EstimateHistory, status: str = "completed") -> ErrorCurve:
    """Compare a history of estimates with the grasp that was true at each time."""
    t, q, r = (np.asarray(part, dtype=np.float64) for part in history[:3])
    true_R, true_r = recording.truth.grasp_at(t)
    true_q = np.broadcast_to(recording.truth.rotation_wxyz, q.shape)
    if recording.truth.changes:
        true_q = matrix_to_quaternion_wxyz(true_R)
    nearer = np.where(np.einsum("ni,ni->n", q, true_q) < 0.0, -1.0, 1.0)[:, None]
    turned = moved = None
    if len(history) == 4:
        covariance = np.asarray(history[3], dtype=np.float64)
        # A small rotation by an angle changes the unit quaternion by half of it.
        turned = 0.5 * norm_band(covariance[:, :3, :3])
        moved = norm_band(covariance[:, 3:, 3:])
    return ErrorCurve(
        t,
        np.abs(nearer * q - true_q),
        angle_between(true_R, quaternion_wxyz_to_matrix(q)),
        np.abs(r - true_r),
        status,
        turned,
        moved,
    )


def norm_band(covariance: FloatArray, probability: float = 0.95) -> FloatArray:
    """Where the norm of a zero-mean Gaussian vector lies, by its quantiles over 20 000 fixed draws.

    Parameters
    ----------
    covariance : ndarray, shape (k, n, n)
    probability : float
        Of lying inside; as much is left out below as above.

    Returns
    -------
    ndarray, shape (k, 2)
        Lower and upper end.
    """
    variances = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    squares = np.random.default_rng(0).standard_normal((20000, covariance.shape[-1])) ** 2
    ends = np.array([0.5 - 0.5 * probability, 0.5 + 0.5 * probability])
    return np.asarray(np.sqrt(np.quantile(squares @ variances.T, ends, axis=0)).T)


def _run(recording: GraspRecording, seed: int, literal: bool) -> CehajicResult:
    return estimate_cehajic2015(paper_inputs(recording, seed=seed), literal=literal)


def final_errors(
    motion: Motion, seeds: Iterable[int] = range(10), *, literal: bool = False, **options: object
) -> FinalErrors:
    """Final errors of the paper's estimator over several seeds of noise, biases and gravity error (about 3 s a seed).

    Parameters
    ----------
    motion : {"printed", "exciting"}
        Of the scenario.
    seeds : iterable of int
        One run each.
    literal : bool
        The printed formulas instead of the corrected ones.
    **options
        Passed to the scenario :func:`factorgrasp.simulation.cehajic2015.cehajic2015`.
    """
    angle, translation, diverged = [], [], 0
    for seed in seeds:
        recording = cehajic2015(seed, motion=motion, **options)  # type: ignore[arg-type]
        result = _run(recording, seed, literal)
        last = (result.t[-1:], result.rotation_wxyz[-1:], result.translation[-1:])
        curve = error_curve(recording, last)
        angle.append(curve.angle[-1])
        translation.append(curve.translation_norm[-1])
        diverged += result.status == "diverged"
    return FinalErrors(np.array(angle), np.array(translation), diverged)


def reproduce_fig4(
    path: str | os.PathLike[str] | None = None,
    *,
    seed: int = 0,
    duration: float = 60.0,
    extra_curves: Mapping[str, Callable[[GraspRecording], EstimateHistory]] | None = None,
) -> Fig4:
    """Run the paper's estimator on the printed and on an exciting motion, and draw the errors over time.

    Parameters
    ----------
    path : path, optional
        Where to save the picture (the ending decides the format); nothing is drawn without it.
    seed : int
        Of the scenario.
    duration : float
        s.
    extra_curves : mapping, optional
        Label to a function that estimates the grasp from a recording, to be drawn beside the paper's: it returns times, quaternions
        [w, x, y, z] and translations, and its covariances where it states them (see :data:`EstimateHistory`).

    Returns
    -------
    Fig4
    """
    recordings = {motion: cehajic2015(seed, motion=motion, duration=duration) for motion in MOTIONS}
    curves: dict[Motion, dict[str, ErrorCurve]] = {}
    for motion, recording in recordings.items():
        curves[motion] = {}
        for label, literal in ((_CORRECTED, False), (_LITERAL, True)):
            result = _run(recording, seed, literal)
            history = (result.t, result.rotation_wxyz, result.translation)
            curves[motion][label] = error_curve(recording, history, result.status)
        for label, estimator in (extra_curves or {}).items():
            curves[motion][label] = error_curve(recording, estimator(recording))
    excitation: dict[Motion, FloatArray] = {
        motion: np.asarray(np.linalg.eigvalsh(excitation_gramian(recording.robot_truth)), dtype=np.float64)
        for motion, recording in recordings.items()
    }
    data = Fig4(recordings, curves, excitation)
    if path is not None:
        draw_fig4(data, path)
    return data


_CORRECTED = "paper, formulas corrected"
_LITERAL = "paper, as printed"
_COLOURS = ("#2d69c4", "#9aa3ae", "#c2473d", "#2c8a57", "#8e5ea2", "#b8791a")
_COMPONENTS = {_CORRECTED: "#a9c4ec"}
_FEW_POINTS = 100


def draw_fig4(data: Fig4, path: str | os.PathLike[str]) -> None:
    """Draw the errors over time, orientation above and displacement below, one column for each motion."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, motion in enumerate(MOTIONS):
        above, below = axes[0][column], axes[1][column]
        eigenvalues = ", ".join(
            "0" if value < 1e-9 * data.excitation[motion][-1] else f"{value:.3g}"
            for value in data.excitation[motion]
        )
        above.set_title(
            f"{_TITLES[motion]}\nexcitation eigenvalues over the run: {eigenvalues} s$^{{-3}}$",
            fontsize=10,
            loc="left",
        )
        for colour, (label, curve) in zip(_COLOURS, data.curves[motion].items(), strict=False):
            _draw_curve(above, below, curve, label, colour)
        below.set_xlabel("time [s]")
    # From -1: the printed formulas leave the picture almost at once, along the axis.
    axes[0][0].set_xlim(-1.0, max(float(recording.robot.t[-1]) for recording in data.recordings.values()))
    axes[0][0].set_ylabel("orientation error $|q - \\hat q|$")
    axes[1][0].set_ylabel("displacement error $|r - \\hat r|$ [m]")
    axes[0][0].set_yscale("log")
    axes[0][0].set_ylim(1e-5, 3.0)
    axes[1][0].set_yscale("log")
    axes[1][0].set_ylim(3e-5, 1e3)
    handles, labels = axes[1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(os.fspath(path), dpi=120)


_TITLES: dict[Motion, str] = {
    "printed": "motion as printed: one fixed axis",
    "exciting": "exciting motion: the axis itself turns",
}


def _draw_curve(above: Axes, below: Axes, curve: ErrorCurve, label: str, colour: str) -> None:
    # As printed the orientation jumps with every sample: few points, thin and behind, or it would hide all the rest.
    wild = label == _LITERAL
    every = slice(None, None, max(1, curve.t.size // (600 if wild else 2400)))
    t = curve.t[every]
    marker = "o" if t.size <= _FEW_POINTS else ""
    above.plot(
        t,
        curve.quaternion_norm[every],
        marker=marker,
        markersize=2.5,
        color=colour,
        linewidth=0.3 if wild else 1.4,
        zorder=0.5 if wild else 3,
    )
    below.plot(
        t,
        curve.translation_norm[every],
        ":" if wild else "-",
        marker=marker,
        markersize=2.5,
        color=colour,
        linewidth=1.8 if wild else 1.4,
        label=label,
        zorder=3,
    )
    if label in _COMPONENTS:
        light = _COMPONENTS[label]
        above.plot(t, curve.quaternion_error[every], color=light, linewidth=0.5, zorder=1)
        lines = below.plot(t, curve.translation_error[every], color=light, linewidth=0.5, zorder=1)
        lines[0].set_label("its components")
    for axes, band, name in (
        (above, curve.quaternion_band, ""),
        (below, curve.translation_band, "95 % band of its own covariance"),
    ):
        if band is not None:
            low, high = band[every].T
            axes.fill_between(t, low, high, color=colour, alpha=0.18, linewidth=0.0, label=name, zorder=2)
    for axes in (above, below):
        axes.grid(True, color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
