"""Robot arms from URDF: poses of a frame for a recording of joint positions (pinocchio)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray, IntArray


def load_robot(urdf: str | Path) -> Any:
    """``pinocchio.Model`` of a URDF file (kinematics and inertias only; meshes are not read).

    Raises
    ------
    InputError
        When the file is missing or is no URDF.
    """
    import pinocchio

    path = Path(urdf)
    if not path.is_file():
        raise InputError("robot.urdf", "an existing URDF file", str(path))
    try:
        return pinocchio.buildModelFromUrdf(str(path))
    except (ValueError, RuntimeError) as error:
        raise InputError("robot.urdf", "a URDF file that pinocchio reads", f"{path}: {error}") from error


def joint_columns(model: Any, names: Sequence[str] | None, width: int) -> IntArray:
    """Index into the configuration of every recorded column.

    Columns are matched by joint name where they have one, and taken in the model's order where they are called ``q1 ... qn``.
    """
    known = {
        model.names[i]: int(model.joints[i].idx_q) for i in range(1, model.njoints) if model.joints[i].nq == 1
    }
    if len(known) != model.njoints - 1:
        raise InputError(
            "robot.urdf", "joints of one coordinate each (revolute or prismatic)", "a joint with more"
        )
    if names is not None and all(name in known for name in names):
        return np.array([known[name] for name in names], dtype=np.intp)
    generic = names is None or all(name.lstrip("q").isdigit() for name in names)
    if not generic:
        unknown = [name for name in names or () if name not in known]
        raise InputError("robot joint columns", "joints among " + ", ".join(known), ", ".join(unknown))
    if width > model.nq:
        raise InputError("robot joint columns", f"at most {model.nq} (the joints of the URDF)", str(width))
    return np.arange(width, dtype=np.intp)


def _configurations(model: Any, q: FloatArray, names: Sequence[str] | None) -> FloatArray:
    import pinocchio

    full = np.tile(pinocchio.neutral(model), (q.shape[0], 1))
    full[:, joint_columns(model, names, q.shape[1])] = q
    return np.asarray(full)


def frame_id(model: Any, frame: str) -> int:
    """Index of a frame; an unknown one lists those there are."""
    if not model.existFrame(frame):
        raise InputError("robot.frame", "one of " + ", ".join(f.name for f in model.frames), repr(frame))
    return int(model.getFrameId(frame))


def end_effector_poses(
    model: Any, frame: str, q: FloatArray, names: Sequence[str] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Positions ``p_w_r`` (n, 3) in m and quaternions [w, x, y, z] of ``R_w_r`` (n, 4); NaN rows of `q` (n, columns) stay NaN."""
    import pinocchio

    index, data = frame_id(model, frame), model.createData()
    position, rotation = np.full((q.shape[0], 3), np.nan), np.full((q.shape[0], 3, 3), np.nan)
    full = _configurations(model, q, names)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)):
        pinocchio.forwardKinematics(model, data, full[k])
        placement = pinocchio.updateFramePlacement(model, data, index)
        position[k], rotation[k] = placement.translation, placement.rotation
    from factorgrasp import lie

    return position, lie.matrix_to_quaternion_wxyz(rotation, continuous=True)


def frame_error_sd(
    model: Any, frame: str, q: FloatArray, names: Sequence[str] | None, joint_sd: float
) -> tuple[float, float]:
    """Position (m) and rotation (rad) sd per axis of a frame for independent joint errors of `joint_sd`, averaged over the recording."""
    import pinocchio

    index, data = frame_id(model, frame), model.createData()
    full = _configurations(model, q, names)
    good = np.flatnonzero(np.isfinite(q).all(axis=1))
    columns = joint_columns(model, names, q.shape[1])
    spread = np.zeros(6)
    chosen = good[:: max(1, good.size // 50)]
    for k in chosen:
        J = pinocchio.computeFrameJacobian(model, data, full[k], index, pinocchio.LOCAL)[:, columns]
        spread += np.sum(J**2, axis=1)
    spread *= joint_sd**2 / max(chosen.size, 1)
    return float(np.sqrt(spread[:3].mean())), float(np.sqrt(spread[3:].mean()))
