"""A measured hand (optical motion capture) before a simulated RGB-D camera: real motion, real drop-outs, and a truth.

Reads the recording of a gloved hand that grasps a pillow (dfki-ric/hand_embodiment, BSD-3-Clause), as an NPZ with ``t`` (n,), ``names``
(k,) and ``xyz_m`` (n, k, 3), NaN where a marker was lost. A rigid triad on the back of the hand (`hand_top`, `hand_left`,
`hand_right`) gives the hand's pose.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.lie import project_to_so3, so3_log
from factorgrasp.models.camera import Camera
from factorgrasp.models.markers import PALM_NAMES, PALM_POINTS
from factorgrasp.signals.savgol import savgol_derivatives
from factorgrasp.simulation.wrist import WristRecording, make_sensing, record
from factorgrasp.simulation.wrist_motion import WristMotion
from factorgrasp.simulation.wrist_sensing import WristSensing
from factorgrasp.typing import BoolArray, FloatArray

MOCAP_CAMERA = Camera(615.0, 615.0, 319.5, 239.5, 640, 480)
TRIAD = ("hand_top", "hand_left", "hand_right")
REAL_MARKERS = (*TRIAD, "index_middle", "middle_middle", "ring_middle")
"""The hard mode's six blobs. The last three are on the proximal fingers and move with them."""
TIPS = ("thumb_tip", "index_tip", "middle_tip", "ring_tip", "little_tip")
"""The lost samples of these hide the virtual markers of the same fingers."""


def wrist_mocap(
    path: str | PathLike[str],
    seed: int = 0,
    *,
    markers: Literal["virtual", "real"] = "virtual",
    start: float = 0.0,
    duration: float | None = None,
    distance: float = 0.87,
    layout_sd: float | None = None,
    camera: Camera = MOCAP_CAMERA,
    sensing: WristSensing | None = None,
    **options: Any,
) -> WristRecording:
    """A simulated camera's view of a measured hand.

    Parameters
    ----------
    path : path
        The NPZ.
    seed : int
        Of noise, misses and clutter.
    markers : {"virtual", "real"}
        ``"virtual"``: the rigid palm of :data:`factorgrasp.models.markers.PALM_POINTS`, carried by the triad, with the fingertips'
        own drop-outs. ``"real"``: :data:`REAL_MARKERS` as they were measured; they are not rigid.
    start, duration : float
        Part of the recording (s); by default all of it. (Its third sample has a jump of 4.5 degrees of the triad.)
    distance : float
        From the camera to the middle of the hand's way (m); the camera looks at the back of the hand.
    layout_sd : float, optional
        That the given layout states (m): by default 1 mm for virtual markers, with errors as large, and 5 mm for real ones, whose
        layout is the mean of their first second.
    camera : Camera
    sensing : WristSensing, optional
    **options
        Fields of :class:`WristSensing`.

    Returns
    -------
    WristRecording
        Its frames have the stamps of the mocap samples nearest to the camera's clock, so that nothing is interpolated. `truth.angles`
        is None: the hand has no neutral posture.

    Raises
    ------
    InputError
        For a file without the triad, or a part of the recording without it.
    """
    if markers not in ("virtual", "real"):
        raise InputError("markers", "'virtual' or 'real'", repr(markers))
    seen = make_sensing(sensing or WristSensing(), options)
    t, xyz, names = _read(
        Path(path), (*REAL_MARKERS, "little_middle", *(TIPS if markers == "virtual" else ()))
    )
    column = {name: k for k, name in enumerate(names)}
    R, p = _hand_frame(xyz, column)
    v, w = _velocities(t, R, p)
    inner = np.isfinite(v).all(axis=1) & np.isfinite(w).all(axis=1)
    t, xyz, R, p, v, w = (values[inner] for values in (t, xyz, R, p, v, w))

    end = t[-1] if duration is None else min(t[-1], t[0] + start + duration)
    clock = np.arange(t[0] + start, end + 1e-9, 1.0 / seen.rate)
    at = np.unique(np.searchsorted(t, clock - 0.5 * float(np.median(np.diff(t)))).clip(0, t.size - 1))
    if at.size < 2:
        raise InputError(
            "start, duration", f"a part of the {t[-1] - t[0]:.1f} s of the recording", f"{start}, {duration}"
        )
    R_0, p_0 = R[at[0]], p[at[0]]
    motion = WristMotion(
        t[at] - t[at[0]],
        np.full((at.size, 3), np.nan),
        R_0.T @ R[at],
        (p[at] - p_0) @ R_0,
        v[at] @ R_0,
        w[at],
    )
    T = np.eye(4)
    T[:3, :3] = _view(R[at]) @ R_0
    T[:3, 3] = np.array([0.0, 0.0, distance]) - T[:3, :3] @ motion.position.mean(axis=0)

    rng = np.random.default_rng([seed, 6])
    local: FloatArray | None = None
    covered: BoolArray | None = None
    if markers == "virtual":
        points, labels, stated, error = np.array(PALM_POINTS), PALM_NAMES, 1e-3, layout_sd
        covered = np.zeros((at.size, len(points)), dtype=bool)
        covered[:, 1:] = np.isnan(xyz[at][:, [column[name] for name in TIPS], 0])
    else:
        labels, stated, error = REAL_MARKERS, 5e-3, 0.0
        world = xyz[at][:, [column[name] for name in REAL_MARKERS]]
        local = np.einsum("nkj,nji->nki", world - p[at][:, None], R[at])
        points = np.nanmean(local[: max(1, round(seen.rate))], axis=0)
    return record(
        motion, T, points, labels, camera, seen, rng, stated if layout_sd is None else layout_sd, error,
        name=f"hand mocap ({markers} markers)", angles=False, seen_points=local, covered=covered,
    )  # fmt: skip


def _read(path: Path, needed: tuple[str, ...]) -> tuple[FloatArray, FloatArray, list[str]]:
    try:
        with np.load(path) as file:
            t, names, xyz = (
                np.asarray(file["t"], dtype=float),
                list(map(str, file["names"])),
                np.asarray(file["xyz_m"], dtype=float),
            )
    except FileNotFoundError:
        raise InputError(str(path), "an NPZ with t, names and xyz_m", "no such file") from None
    except (KeyError, ValueError, OSError) as error:
        raise InputError(str(path), "an NPZ with t, names and xyz_m", str(error)) from None
    for name in needed:
        if name not in names:
            raise InputError(f"{path}: names", f"the marker {name!r}", ", ".join(names))
    if xyz.shape != (t.size, len(names), 3):
        raise InputError(f"{path}: xyz_m", f"shape {(t.size, len(names), 3)}", str(xyz.shape))
    if np.isnan(xyz[:, [names.index(name) for name in TRIAD]]).any():
        raise InputError(f"{path}: xyz_m", "the triad on the hand in every sample", "gaps in it")
    return t, xyz, names


def _hand_frame(xyz: FloatArray, column: dict[str, int]) -> tuple[FloatArray, FloatArray]:
    """``R_w_W`` (n, 3, 3) and ``p_w_W`` (n, 3): origin in the triad's centre, x to the middle finger, z out of the back of the hand."""
    triad = xyz[:, [column[name] for name in TRIAD]]
    center = triad.mean(axis=1)
    shape = triad - center[:, None]
    # All samples against the first; the fit of a rigid triad has a closed form.
    reference = shape[0]
    normal = np.cross(reference[1] - reference[0], reference[2] - reference[0])
    full = np.vstack([reference, normal / np.linalg.norm(normal) * np.linalg.norm(reference)])
    normals = np.cross(shape[:, 1] - shape[:, 0], shape[:, 2] - shape[:, 0])
    normals *= np.linalg.norm(reference) / np.linalg.norm(normals, axis=1, keepdims=True)
    moved = np.concatenate([shape, normals[:, None]], axis=1)
    R = project_to_so3(np.einsum("nki,kj->nij", moved, full))

    def mean(name: str) -> FloatArray:
        out: FloatArray = np.nanmean(np.einsum("nj,nji->ni", xyz[:, column[name]] - center, R), axis=0)
        return out

    x = mean("middle_middle")
    z = np.cross(x, mean("index_middle") - mean("little_middle"))
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return R @ np.stack([x, np.cross(z, x), z], axis=1), center


def _velocities(t: FloatArray, R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of the origin in the world, and of the frame in itself: local polynomials over 70 ms."""
    dt = float(np.median(np.diff(t)))
    v = savgol_derivatives(p, dt, 7, 2, 1)
    steps = so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / dt
    # A step belongs to the middle between two samples.
    w = np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
    return v, savgol_derivatives(w, dt, 7, 2, 0)


def _view(R: FloatArray) -> FloatArray:
    """``R_c_w`` of a camera that looks at the back of the hand, the fingers to the right, in the mean of its postures."""
    mean = project_to_so3(R.sum(axis=0))
    return np.diag([1.0, -1.0, -1.0]) @ mean.T
