"""A moving arm with what it holds, as an animation (GIF), a strip of pictures (PNG), or a recording for rerun (.rrd)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp import plots
from factorgrasp.atomic import replacing
from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXIS = 0.12
"""Length of the drawn axes of a frame, m."""
_PER_NEWTON = 0.05
"""Length of the drawn force, m/N."""


@dataclass(frozen=True, eq=False)
class MotionScene:
    """Where everything is over time, world frame, m.

    Attributes
    ----------
    t : (n,) ndarray
        s.
    skeleton : (n, m, 3) ndarray
        The arm as a line from its base to the end-effector; m may be zero.
    position, rotation : (n, 3), (n, 3, 3) ndarray
        End-effector, ``p_w_r`` and ``R_w_r``.
    hand : (n, 3) ndarray
        The wrist, ``p_w_h``.
    force : (n, 3) ndarray or None
        On the wrist, N.
    """

    t: FloatArray
    skeleton: FloatArray
    position: FloatArray
    rotation: FloatArray
    hand: FloatArray
    force: FloatArray | None = None

    @classmethod
    def of_joints(
        cls,
        t: FloatArray,
        q: FloatArray,
        model: Any,
        frame: int | str,
        lever: FloatArray,
        force: FloatArray | None = None,
    ) -> MotionScene:
        """From joint positions.

        Parameters
        ----------
        t, q : (n,), (n, nq) ndarray
            s, rad.
        model : pinocchio.Model
        frame : int or str
            The end-effector.
        lever : (3,) ndarray
            ``p_r_h``, m.
        force : (n, 3) ndarray, optional
            On the wrist, N, world axes.
        """
        import pinocchio

        index = model.getFrameId(frame) if isinstance(frame, str) else frame
        # Without the universe, which the pictures add as the base.
        chain = [joint for joint in model.supports[model.frames[index].parentJoint] if joint]
        data = model.createData()
        skeleton = np.empty((t.size, len(chain) + 1, 3))
        position, rotation = np.empty((t.size, 3)), np.empty((t.size, 3, 3))
        for k in range(t.size):
            pinocchio.forwardKinematics(model, data, q[k])
            at = pinocchio.updateFramePlacement(model, data, index)
            position[k], rotation[k] = at.translation, at.rotation
            for i, joint in enumerate(chain):
                skeleton[k, i] = data.oMi[joint].translation
            skeleton[k, -1] = position[k]
        return cls(t, skeleton, position, rotation, position + rotation @ np.asarray(lever), force)

    def every(self, seconds: float) -> MotionScene:
        """About one instant every so many seconds."""
        step = float(np.median(np.diff(self.t)))
        keep = slice(None, None, max(1, round(seconds / step)))
        return MotionScene(
            self.t[keep],
            self.skeleton[keep],
            self.position[keep],
            self.rotation[keep],
            self.hand[keep],
            None if self.force is None else self.force[keep],
        )


def animate(
    scene: MotionScene, path: str | os.PathLike[str], rate: float = 12.0, title: str = "", width: float = 4.2
) -> Path:
    """Write an animated GIF in real time; returns the path.

    Parameters
    ----------
    scene : MotionScene
    path : path
        Ends in .gif.
    rate : float
        Pictures a second.
    title : str
    width : float
        inches at 80 dots.
    """
    from matplotlib.animation import PillowWriter

    file = Path(path)
    if file.suffix.lower() != ".gif":
        raise InputError(str(file), "a name that ends in .gif", file.suffix or "no ending")
    some = scene.every(1.0 / rate)
    made, axes = plots.figure(width, 0.85 * width, subplot_kw={"projection": "3d"})
    writer = PillowWriter(fps=round(rate))
    with replacing(file) as temporary:
        # The writer asks the name for the format.
        target = temporary.with_suffix(".gif")
        with writer.saving(made, str(target), 80):
            for k in range(some.t.size):
                _draw(axes[0], some, k, scene, f"{title}  {some.t[k]:.1f} s".strip())
                writer.grab_frame()
        os.replace(target, temporary)
    return file


def strip(
    scene: MotionScene,
    path: str | os.PathLike[str],
    times: Sequence[float] | None = None,
    title: str = "",
) -> Path:
    """Write some instants side by side as one picture; returns the path.

    Parameters
    ----------
    scene : MotionScene
    path : path
        The ending decides the format.
    times : sequence of float, optional
        s; five equal steps by default.
    title : str
    """
    file = Path(path)
    wanted = np.linspace(scene.t[0], scene.t[-1], 5) if times is None else np.asarray(times, dtype=float)
    made, axes = plots.figure(2.6 * wanted.size, 2.7, columns=wanted.size, subplot_kw={"projection": "3d"})
    for ax, t in zip(axes, wanted, strict=True):
        k = int(np.clip(np.searchsorted(scene.t, t), 0, scene.t.size - 1))
        _draw(ax, scene, k, scene, f"{title}  {scene.t[k]:.1f} s".strip())
    with replacing(file) as temporary:
        made.savefig(
            temporary, format=file.suffix.lstrip(".") or "png", dpi=90, facecolor=plots.PALETTE["paper"]
        )
    return file


def save_rrd(scene: MotionScene, path: str | os.PathLike[str], rate: float = 30.0) -> Path:
    """Write a recording for the viewer rerun (extra ``viewer``); returns the path.

    Raises
    ------
    InputError
        When rerun is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise InputError(
            "viewer", "rerun-sdk", "it is not installed", "pip install 'factorgrasp[viewer]'"
        ) from error
    file, some = Path(path), scene.every(1.0 / rate)
    with replacing(file) as temporary:
        stream = rr.RecordingStream("factorgrasp")
        stream.save(str(temporary))
        for k in range(some.t.size):
            stream.set_time("time", duration=float(some.t[k]))
            if some.skeleton.shape[1]:
                stream.log("arm", rr.LineStrips3D([some.skeleton[k]], radii=0.02))
            stream.log("object", rr.LineStrips3D([np.stack([some.position[k], some.hand[k]])], radii=0.01))
            stream.log("wrist", rr.Points3D([some.hand[k]], radii=0.03))
            stream.log(
                "end_effector",
                rr.Transform3D(translation=some.position[k], mat3x3=some.rotation[k]),
            )
            if some.force is not None:
                stream.log(
                    "force", rr.Arrows3D(origins=[some.hand[k]], vectors=[_PER_NEWTON * some.force[k]])
                )
        stream.flush()
        stream.disconnect()
    return file


@plots.styled
def _draw(ax: Axes, scene: MotionScene, k: int, whole: MotionScene, title: str) -> None:
    """One instant; the view spans the whole motion."""
    picture: Any = ax
    picture.clear()
    if scene.skeleton.shape[1]:
        line = np.vstack([np.zeros(3), scene.skeleton[k]])
        picture.plot(
            *line.T, color=plots.PALETTE["muted"], linewidth=3.0, marker="o", markersize=3.0, zorder=2
        )
    ends = np.stack([scene.position[k], scene.hand[k]])
    picture.plot(*ends.T, color=plots.PALETTE["ink"], linewidth=2.0)
    for axis, name in enumerate(plots.AXES):
        tip = scene.position[k] + _AXIS * scene.rotation[k][:, axis]
        picture.plot(*np.stack([scene.position[k], tip]).T, color=plots.PALETTE[name], linewidth=1.6)
    picture.plot(*scene.hand[k : k + 1].T, marker="o", markersize=6.0, color=plots.PALETTE["accent"])
    picture.plot(*whole.position.T, color=plots.PALETTE["z"], linewidth=0.6, alpha=0.6)
    if scene.force is not None:
        tip = scene.hand[k] + _PER_NEWTON * scene.force[k]
        picture.plot(*np.stack([scene.hand[k], tip]).T, color=plots.PALETTE["x"], linewidth=2.0)
    everything = np.vstack([whole.skeleton.reshape(-1, 3), whole.position, whole.hand, np.zeros((1, 3))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * float(np.max(high - low))
    picture.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(middle[2] - half, middle[2] + half),
    )
    picture.set_box_aspect((1, 1, 1))
    picture.view_init(elev=18, azim=-62)
    for which in (picture.xaxis, picture.yaxis, picture.zaxis):
        which.set_ticklabels([])
    picture.set_title(title, y=0.93)
