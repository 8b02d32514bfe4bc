"""The figures and tables of the papers on human dynamics, from simulations with known truth, and the page that shows them.

``python -m factorgrasp.simulation.human_dynamics_figures docs`` writes the figures into ``docs/figures`` and the tables into
``docs/human_dynamics.md``; with ``robustness`` behind it only the first of them.
"""

from __future__ import annotations

import argparse
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import plots
from factorgrasp.errors import InputError
from factorgrasp.human_dynamics_result import HumanDynamicsResult
from factorgrasp.human_dynamics_task import HumanDynamicsTask
from factorgrasp.problems.external_wrenches import ExternalWrenches
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.simulation.human_dynamics import (
    FEET,
    HANDS,
    Carrying,
    HumanRecording,
    human_bowing,
    human_carrying,
    human_tpose,
    inverse_dynamics,
)
from factorgrasp.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE = "human_dynamics.md"
DPI = 120
ARM = ("jRightShoulder", "jRightElbow", "jRightWrist")
HAND_COVARIANCE = (1e4, 1e4, 1e4, 1.0, 1.0, 1.0)
"""Of unmeasured contacts: forces free, moments about where the hand holds small."""


@dataclass(frozen=True)
class Shown:
    """A table with its figure.

    Attributes
    ----------
    header : tuple of str
    rows : tuple of tuple of str
    figure : Figure or None
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    figure: Figure | None = None

    def markdown(self) -> str:
        """The table."""
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, *self.rows)]
        return "\n".join([lines[0], "|" + "---|" * len(self.header), *lines[1:]])


def solve_recording(
    recording: HumanRecording,
    noise: HumanDynamicsNoise | None = None,
    contacts: Sequence[str] = (),
    payload: Sequence[str] = (),
    sensors: Sequence[str] = ("plates",),
) -> tuple[HumanDynamicsResult, BoolArray]:
    """Estimate from noisy motion capture and what else was measured; the second is which frames (n,) there are.

    Parameters
    ----------
    recording : HumanRecording
    noise : HumanDynamicsNoise, optional
        By default the noise of the motion, with :data:`HAND_COVARIANCE` for contacts.
    contacts, payload : sequence of str
        Unmeasured contacts (acting at the centres of mass), and those that hold an object.
    sensors : sequence of {"plates", "imus", "hands"}
    """
    motion, keep, own = recording.measured_motion
    chosen = replace(own, contact_wrench=HAND_COVARIANCE) if noise is None else noise
    made: dict[str, Callable[[], list[Sensor]]] = {
        "plates": lambda: [*recording.foot_sensors(motion, keep)],
        "imus": lambda: [*recording.imus(keep)],
        "hands": lambda: [*recording.hand_sensors(keep)],
    }
    every = [sensor for name in sensors for sensor in made[name]()]
    points = {link: recording.body.segments[link].com for link in contacts}
    task = HumanDynamicsTask(
        motion,
        every,
        recording.t,
        keep,
        noise=chosen,
        contacts=contacts,
        points=points,
        payload=payload,
    )
    return task.solve(), keep


def robustness(seed: int = 0, torso_mass: float = 6.0) -> Shown:
    """Latella 2018, table 1 and fig. 7: a mass on the torso that the model does not have, with a trusted and a distrusted model.

    ``eps = |tau(with the mass) - tau(without)| - tau(of the mass)``, per joint, over a bowing block; the model never has the mass.
    """
    joints = {"ankle": "Ankle_y", "knee": "Knee_y", "hip": "Hip_y"}
    with_mass, without = human_bowing(seed, torso_mass=torso_mass), human_bowing(seed)
    names = [f"j{side}{tail}" for tail in joints.values() for side in ("Right", "Left")]
    names += ["jL5S1_y"]
    truth = np.abs(with_mass.truth.of(names) - without.truth.of(names))
    errors: dict[str, FloatArray] = {}
    series: dict[str, FloatArray] = {}
    base, keep = _torques(without, HumanDynamicsNoise.latella2018(1e-4), names)
    for label, model in (("model 1e-4", 1e-4), ("model 1e-1", 1e-1)):
        found, _ = _torques(with_mass, HumanDynamicsNoise.latella2018(model), names)
        series[label] = np.abs(found - base) - truth[keep]
        errors[label] = np.sqrt(np.mean(series[label] ** 2, axis=0))
    series["inverse dynamics"] = (
        np.abs(_without_feet(with_mass, names) - _without_feet(without, names))[keep] - truth[keep]
    )
    errors["inverse dynamics"] = np.sqrt(np.mean(series["inverse dynamics"] ** 2, axis=0))
    rows = []
    for k, joint in enumerate([*joints, "L5/S1"]):
        at = slice(2 * k, 2 * k + 2) if k < len(joints) else slice(2 * k, 2 * k + 1)
        sizes = [
            f"{np.sqrt(np.mean(errors[label][at] ** 2)):.2f}"
            for label in ("inverse dynamics", "model 1e-4", "model 1e-1")
        ]
        rows.append((joint, f"{np.sqrt(np.mean(truth[:, at] ** 2)):.2f}", *sizes))
    t = with_mass.t[keep]
    made, axes = plots.figure(7.2, 2.4, columns=2)
    for ax, k, title in ((axes[0], 0, "Right ankle"), (axes[1], 4, "Right hip")):
        curves = [
            (label, series[label][:, k], colour)
            for label, colour in zip(series, ("x", "z", "accent"), strict=False)
        ]
        _curves(ax, title, "error (Nm)", t, curves)
    header = (
        "joint",
        "torque of the mass (Nm)",
        "ID, no plates: error",
        "MAP, model 1e-4: error",
        "MAP, model 1e-1: error",
    )
    return Shown(header, tuple(rows), made)


def _torques(
    recording: HumanRecording, noise: HumanDynamicsNoise, names: Sequence[str]
) -> tuple[FloatArray, BoolArray]:
    own = recording.measured_motion[2]
    joined = replace(
        noise, joint_acceleration=own.joint_acceleration, link_acceleration=own.link_acceleration
    )
    result, keep = solve_recording(recording, joined, sensors=("plates", "imus"))
    return result.frames.torque[:, [result.frames.dof_names.index(name) for name in names]], keep


def _without_feet(recording: HumanRecording, names: Sequence[str]) -> FloatArray:
    """Deterministic inverse dynamics of the model that the estimator knows; the feet get what its own equations of motion ask for."""
    torque = inverse_dynamics(recording.body, recording.truth.trajectory)
    return torque[:, [recording.truth.dof_names.index(name) for name in names]]


def sensor_sets(subjects: int = 10, seed: int = 0) -> Shown:
    """Latella 2018, fig. 8: variances of torques with more and more sensors, while bowing and pushing on a robot's arms."""
    rng = np.random.default_rng(seed)
    sets = {
        "CASE 1": ("plates",),
        "CASE 2": ("plates", "imus"),
        "CASE 3": ("plates", "imus", "hands"),
    }
    names = [f"j{side}{joint}_y" for joint in ("Ankle", "Hip") for side in ("Right", "Left")]
    variances = np.zeros((subjects, len(sets), len(names)))
    for s in range(subjects):
        height, mass = 1.666 + 0.045 * rng.normal(), 61.14 + 5.76 * rng.normal()
        recording = human_bowing(seed + s, push=30.0, repetitions=1, height=height, mass=mass)
        for k, sensors in enumerate(sets.values()):
            hands = () if "hands" in sensors else HANDS
            result, _ = solve_recording(recording, contacts=hands, sensors=sensors)
            at = [result.frames.dof_names.index(name) for name in names]
            variances[s, k] = np.mean(result.frames.torque_sd[:, at] ** 2, axis=0)
    mean = variances.mean(axis=0)
    rows = tuple(
        (label, *(f"{value:.3g}" for value in mean[k]), " + ".join(sensors))
        for k, (label, sensors) in enumerate(sets.items())
    )
    made, (ax,) = plots.figure(7.2, 2.4)
    _bars(ax, tuple(sets), names, mean)
    return Shown(
        ("", "right ankle (Nm²)", "left ankle", "right hip", "left hip", "accelerations of joints and"),
        rows,
        made,
    )


def tpose_efforts(seed: int = 0) -> Shown:
    """Tirupachuri 2021, figs. 3, 10 and 16: efforts (norm of a joint's torques) of the right arm in the T-pose without and with 5 kg."""
    rows = []
    panels = []
    for payload in (0.0, 5.0):
        recording = human_tpose(seed, payload=payload)
        held = ("RightHand",) if payload else ()
        result, keep = solve_recording(recording, contacts=held, payload=held)
        blind, _ = solve_recording(recording)
        during = recording.during("T-pose")[keep]
        ideal = _effort(_ideal_tpose(recording, payload), recording.truth.dof_names)
        true = _effort(recording.truth.torque, recording.truth.dof_names)
        found = _effort(result.frames.torque, result.frames.dof_names)
        plain = _effort(blind.frames.torque, blind.frames.dof_names)
        for k, joint in enumerate(ARM):
            cells = [
                ideal[0, k],
                true[keep][during, k].mean(),
                found[during, k].mean(),
                plain[during, k].mean(),
            ]
            rows.append(
                (
                    f"{payload:.0f} kg",
                    joint.removeprefix("jRight").lower(),
                    *(f"{value:.2f}" for value in cells),
                )
            )
        panels.append((payload, recording.t[keep], found, true[keep]))
    made, axes = plots.figure(7.2, 2.4, columns=2)
    for ax, (payload, t, found, true) in zip(axes, panels, strict=True):
        curves = [
            (joint.removeprefix("jRight").lower(), found[:, k], "xyz"[k]) for k, joint in enumerate(ARM)
        ]
        _curves(ax, f"Effort of the right arm, {payload:.0f} kg in the hand", "Nm", t, curves)
        for k in range(len(ARM)):
            ax.plot(t, true[:, k], color=plots.PALETTE["ink"], linewidth=0.7, linestyle=(0, (3, 3)))
    header = (
        "payload",
        "joint",
        "ideal T-pose (Nm)",
        "truth (Nm)",
        "estimate (Nm)",
        "hand taken to be free (Nm)",
    )
    return Shown(header, tuple(rows), made)


def _effort(torque: FloatArray, names: Sequence[str]) -> FloatArray:
    """Norm over the three axes of every joint of the arm, (n, 3)."""
    parts = [[torque[:, names.index(f"{joint}_{axis}")] for axis in "xyz"] for joint in ARM]
    return np.stack([np.linalg.norm(np.stack(part, axis=1), axis=1) for part in parts], axis=1)


def _ideal_tpose(recording: HumanRecording, payload: float) -> FloatArray:
    """Torques (1, 66) of gravity alone in the zero configuration."""
    import pinocchio as pin

    body = recording.body
    if payload:
        body = body.with_load("RightHand", payload, body.segments["RightHand"].com)
    model = body.model()
    zero = np.zeros(model.nv)
    return np.asarray(pin.rnea(model, model.createData(), pin.neutral(model), zero, zero))[None, 6:]


def hand_covariances(seed: int = 0) -> Shown:
    """Tirupachuri 2021, figs. 11 to 14: force on the hand and mass in it (5 kg) for covariances of the hand's force."""
    recording = human_tpose(seed, payload=5.0)
    motion, keep, own = recording.measured_motion
    during = recording.during("T-pose")[keep]
    feet = recording.foot_sensors(motion, keep)
    upright = motion.R[:, motion.link("RightHand"), 2]
    rows = []
    curves: dict[str, list[tuple[str, FloatArray, str]]] = {
        key: [] for key in ("f joint", "f paper", "m joint", "m paper")
    }
    for variance, colour in zip((1e-4, 1e-2, 1.0, 1e2, 1e4), ("x", "accent", "y", "z", "ink"), strict=True):
        noise = replace(own, contact_wrench=(variance,) * 3 + (1e4,) * 3)
        paper = ExternalWrenches(
            motion,
            [replace(s, covariance=1e-6) for s in feet],
            ("RightHand",),
            replace(noise, free_wrench=1e-6),
            1e-3,
        ).estimate()
        ours, _ = solve_recording(recording, noise, ("RightHand",), ("RightHand",))
        assert ours.payload is not None
        found = {
            "paper": paper.of("RightHand")[:, :3],
            "joint": ours.frames.external_wrench[:, ours.frames.links.index("RightHand"), :3],
        }
        mass = {key: np.linalg.norm(force, axis=1) / 9.80665 for key, force in found.items()}
        rows.append(
            (
                f"{variance:.0e}",
                f"{mass['paper'][during].mean():.2f}",
                f"{mass['joint'][during].mean():.2f}",
                f"{np.nanmean(ours.payload.mass[during]):.2f}",
            )
        )
        for key, force in found.items():
            curves[f"f {key}"].append((f"{variance:.0e}", np.sum(upright * force, axis=1), colour))
            curves[f"m {key}"].append((f"{variance:.0e}", mass[key], colour))
    made, axes = plots.figure(7.2, 4.6, rows=2, columns=2)
    titles = {
        "f joint": ("Upright force on the hand, one estimate (cf. Fig. 11)", "N"),
        "f paper": ("With the non-collocated step (Fig. 13)", "N"),
        "m joint": ("Its mass (cf. Fig. 12)", "kg"),
        "m paper": ("Its mass (Fig. 14)", "kg"),
    }
    for ax, (key, (title, unit)) in zip(axes, titles.items(), strict=True):
        _curves(ax, title, unit, recording.t[keep], curves[key])
    header = (
        "covariance of the hand's force (N²)",
        "non-collocated, feet 1e-6, momentum 1e-3 (kg)",
        "joint estimate (kg)",
        "payload, prior taken out (kg)",
    )
    return Shown(header, tuple(rows), made)


def feet_covariances(seed: int = 0) -> Shown:
    """Tirupachuri 2021, figs. 8 and 9: how far the estimated wrenches of the feet are from the measured ones, by their covariance."""
    recording = human_tpose(seed)
    motion, keep, own = recording.measured_motion
    noise = replace(
        HumanDynamicsNoise.tirupachuri2021(),
        joint_acceleration=own.joint_acceleration,
        link_acceleration=own.link_acceleration,
    )
    measured = recording.foot_sensors(motion, keep)
    index = [motion.link(sensor.link) for sensor in measured]
    rows, curves = [], []
    tracked: list[tuple[str, FloatArray, str]] = []
    for variance, colour in zip((1e-6, 1e-4, 1e-2, 1.0, 1e2), ("ink", "z", "y", "accent", "x"), strict=True):
        result = HumanDynamicsTask(
            motion, [replace(s, covariance=variance) for s in measured], noise=noise
        ).solve()
        R = motion.R[:, index]
        force, moment = (
            np.einsum("nlij,nlj->nli", R, result.frames.external_wrench[:, index, part])
            for part in (slice(0, 3), slice(3, 6))
        )
        values = np.stack([sensor.values for sensor in measured], axis=1)
        off = [np.linalg.norm(part, axis=2) for part in (force - values[..., :3], moment - values[..., 3:])]
        rows.append((f"{variance:.0e}", *(f"{np.sqrt(np.mean(part**2)):.3g}" for part in off)))
        curves.append((f"{variance:.0e}", off[0][:, 0], colour))
        if variance == 1e-6:
            tracked = [("estimate", force[:, 0, 2], "z"), ("measurement", values[:, 0, 2], "ink")]
    made, (ax, close) = plots.figure(7.2, 2.6, columns=2)
    t = recording.t[keep]
    _curves(ax, "Right foot: estimate less measurement (Fig. 8)", "N", t, curves, log=True)
    _curves(close, "Right foot, upright force, 1e-6 (Fig. 9)", "N", t, tracked, dashed=1)
    return Shown(
        ("covariance of the feet (N², (Nm)²)", "force, RMS difference (N)", "moment, RMS difference (Nm)"),
        tuple(rows),
        made,
    )


def carrying(seed: int = 0) -> Shown:
    """Tirupachuri 2021, figs. 17 and 18: 9.55 kg in both hands while standing, on one foot and walking."""
    rows = []
    made, axes = plots.figure(7.2, 6.2, rows=3, columns=2)
    motions: tuple[Carrying, ...] = ("standing", "one_foot", "walking")
    for row, motion in enumerate(motions):
        recording = human_carrying(seed, motion=motion)
        result, keep = solve_recording(recording, contacts=HANDS, payload=HANDS)
        assert result.payload is not None
        mass, sd = result.payload.mass, result.payload.mass_sd
        feet = np.sum([recording.plates[link].force for link in FEET], axis=0)[keep]
        paper = np.linalg.norm(feet, axis=1) / 9.80665 - recording.body.mass
        for phase in recording.phases:
            during = recording.during(phase)[keep]
            rows.append(
                (
                    f"{motion.replace('_', ' ')}: {phase}",
                    f"{paper[during].mean():.2f} ± {paper[during].std():.2f}",
                    f"{mass[during].mean():.2f} ± {mass[during].std():.2f}",
                    f"{np.median(sd[during]):.2f}",
                )
            )
        t, name = recording.t[keep], motion.replace("_", " ")
        hands = [result.frames.links.index(link) for link in HANDS]
        force = np.einsum(
            "nlj,nlj->nl", result.rotation[:, hands, 2], result.frames.external_wrench[:, hands, :3]
        )
        _curves(
            axes[2 * row], f"{name}: upright force on the hands", "N", t,
            [("right", force[:, 0], "x"), ("left", force[:, 1], "z")],
        )  # fmt: skip
        _curves(
            axes[2 * row + 1],
            f"{name}: mass",
            "kg",
            t,
            [("feet less body", paper, "x"), ("estimate", mass, "z")],
        )
        axes[2 * row + 1].axhline(9.55, color=plots.PALETTE["ink"], linewidth=0.8)
    header = ("phase", "force of the feet less the body (kg)", "estimate (kg)", "stated sd of a frame (kg)")
    return Shown(header, tuple(rows), made)


FIGURES: dict[str, Callable[[], Shown]] = {
    "robustness": robustness,
    "sensor_sets": sensor_sets,
    "tpose_efforts": tpose_efforts,
    "feet_covariances": feet_covariances,
    "hand_covariances": hand_covariances,
    "carrying": carrying,
}


def write_page(folder: Path, names: Sequence[str] = tuple(FIGURES)) -> list[Path]:
    """Draw figures into ``folder/figures`` and renew the tables between ``<!-- name -->`` and ``<!-- end -->`` in the page.

    Raises
    ------
    InputError
        For a name that is none, or a page without its place.
    """
    from factorgrasp.atomic import replacing, write_text

    page = folder / PAGE
    text = page.read_text(encoding="utf-8")
    written = []
    for name in names:
        if name not in FIGURES:
            raise InputError("figure", "one of " + ", ".join(FIGURES), repr(name))
        shown = FIGURES[name]()
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not place.search(text):
            raise InputError(str(page), f"a place for {name}: <!-- {name} --> ... <!-- end -->", "none")
        content = shown.markdown()
        text = place.sub(_put(content), text)
        if shown.figure is not None:
            path = folder / "figures" / f"human_dynamics_{name}.png"
            with replacing(path) as temporary:
                _write_png(shown.figure, temporary)
            written.append(path)
    return [*written, write_text(page, text)]


def _write_png(made: Figure, path: Path) -> None:
    """A picture of few colours, which lines and axes are: a third of the size."""
    from PIL import Image

    stream = io.BytesIO()
    made.savefig(stream, format="png", dpi=DPI, facecolor=plots.PALETTE["paper"])
    with Image.open(stream) as picture:
        picture.convert("RGB").quantize(48).save(path, format="png", optimize=True)


def _put(content: str) -> Callable[[re.Match[str]], str]:
    return lambda match: f"{match[1]}{content}\n{match[2]}"


@plots.styled
def _bars(ax: Axes, groups: Sequence[str], names: Sequence[str], heights: FloatArray) -> None:
    for j, name in enumerate(names):
        colour = plots.PALETTE["z" if "Ankle" in name else "accent"]
        shade = 1.0 if "Right" in name else 0.6
        ax.bar(
            np.arange(len(groups)) + 0.2 * (j - 1.5),
            heights[:, j],
            0.18,
            color=colour,
            alpha=shade,
            label=name,
        )
    ax.set_xticks(range(len(groups)), list(groups))
    ax.set_ylabel("variance of the torque (Nm²)")
    ax.legend(ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)


@plots.styled
def _curves(
    ax: Axes,
    title: str,
    unit: str,
    t: FloatArray,
    curves: Sequence[tuple[str, FloatArray, str]],
    log: bool = False,
    dashed: int = -1,
) -> None:
    for k, (label, values, colour) in enumerate(curves):
        style = (0, (3, 3)) if k == dashed else "-"
        ax.plot(t, values, color=plots.PALETTE[colour], label=label, linewidth=1.0, linestyle=style)
    ax.set_title(title)
    ax.set_ylabel(unit)
    ax.set_xlabel("time (s)")
    if log:
        ax.set_yscale("log")
    low, high = ax.get_ylim()
    # Room for the legend, which must not cover a curve.
    ax.set_ylim(low, high * (high / low) ** 0.3 if log else high + 0.3 * (high - low))
    ax.legend(
        ncols=2 if len(curves) < 4 else 3,
        loc="upper right",
        fontsize=7.0,
        frameon=True,
        framealpha=0.85,
        edgecolor="none",
        handlelength=1.2,
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="Draw the figures of the human-dynamics page and renew its tables."
    )
    parser.add_argument("folder", type=Path, help=f"folder with {PAGE}")
    parser.add_argument("names", nargs="*", default=list(FIGURES), help="of: " + ", ".join(FIGURES))
    arguments = parser.parse_args()
    for path in write_page(arguments.folder, arguments.names):
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
