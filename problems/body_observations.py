"""Where markers and segments of a suit are seen, as residuals of a body's configuration (mathematics 4.3, equation 12c)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.models.joint_motion import free_flyer
from factorgrasp.problems.link_motion_check import check_names
from factorgrasp.problems.link_motion_spatial import rotate
from factorgrasp.toml_tables import close_matches
from factorgrasp.typing import FloatArray, IntArray

LIMIT_SD = 0.02
"""Rad beyond a joint's limit that cost as much as one standard deviation."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where markers sit on a body.

    Attributes
    ----------
    names : tuple of str
    links : tuple of str
        Link (frame of the model) of every marker.
    position : ndarray, shape (m, 3)
        In the link's frame, m.
    sd : ndarray, shape (m,)
        Noise of one coordinate of one sample: of the camera and, as far as it is not constant, of the skin, m.
    """

    names: tuple[str, ...]
    links: tuple[str, ...]
    position: FloatArray
    sd: FloatArray

    def __post_init__(self) -> None:
        count = len(self.names)
        check_names(self.names, "markers")
        for name, shape in (("position", (count, 3)), ("sd", (count,))):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(
                    f"{name} of the markers", f"finite numbers of shape {shape}", str(value.shape)
                )
            object.__setattr__(self, name, value)
        if len(self.links) != count:
            raise InputError("links of the markers", f"{count} names", str(len(self.links)))
        if (self.sd <= 0.0).any():
            raise InputError("sd of the markers", "above 0 m", f"{self.sd.min():g}")


@dataclass(frozen=True, eq=False)
class BodyObservations:
    """Markers and poses of links over n frames; NaN where something was not seen: its rows drop out.

    Attributes
    ----------
    placement : Placement
    markers : ndarray, shape (n, m, 3)
        Positions in the world, m.
    posed : tuple of str
        Links whose pose is measured.
    R, p : ndarray
        (n, k, 3, 3) ``R_w_l`` and (n, k, 3) of those.
    orientation_sd, position_sd : float
        Of a pose, rad and m.
    """

    placement: Placement
    markers: FloatArray
    posed: tuple[str, ...] = ()
    R: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3, 3)))
    p: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    orientation_sd: float = 0.01
    position_sd: float = 0.005

    def __len__(self) -> int:
        return int(self.markers.shape[0])

    def select(self, frames: Any) -> BodyObservations:
        """The same at some of the frames."""
        from dataclasses import replace

        return replace(
            self,
            markers=self.markers[frames],
            R=self.R[frames] if self.posed else self.R,
            p=self.p[frames] if self.posed else self.p,
        )


def poses_only(
    posed: Sequence[str],
    R: FloatArray,
    p: FloatArray,
    orientation_sd: float = 0.01,
    position_sd: float = 0.005,
) -> BodyObservations:
    """Observations that are poses of links, (n, k, 3, 3) and (n, k, 3), such as those of a motion suit."""
    none = Placement((), (), np.zeros((0, 3)), np.zeros(0))
    return BodyObservations(none, np.zeros((len(R), 0, 3)), tuple(posed), R, p, orientation_sd, position_sd)


class ObservedBody:
    """Residuals and their derivatives of many configurations at once.

    Parameters
    ----------
    model : pinocchio.Model
        Hinges, sliders and ball joints, with or without a free-flyer as first joint.
    observations : BodyObservations

    Notes
    -----
    A step (nv,) is added to a configuration as pinocchio does, except that the translation of a free-flyer is in world axes.
    """

    def __init__(self, model: Any, observations: BodyObservations) -> None:
        self.model, self.observations = model, observations
        self._data = model.createData()
        self.floating = model.njoints > 1 and model.joints[1].shortname() == "JointModelFreeFlyer"
        place = observations.placement
        self._marker_frames, self._marker_at, self._marker_turn = self._points(
            place.links, place.position, place.names
        )
        self._marker_origin = self._points(place.links, np.zeros_like(place.position), place.names)[1]
        self._pose_frames, self._pose_at, self._pose_turn = self._points(
            observations.posed, np.zeros((len(observations.posed), 3)), observations.posed
        )
        support = np.zeros((model.njoints, model.nv), dtype=bool)
        for i in range(1, model.njoints):
            support[i] = support[int(model.parents[i])]
            support[i, model.idx_vs[i] : model.idx_vs[i] + model.nvs[i]] = True
        self._support = support
        weights = [np.repeat(1.0 / place.sd, 3)]
        k = len(observations.posed)
        weights += [
            np.full(3 * k, 1.0 / observations.position_sd),
            np.full(3 * k, 1.0 / observations.orientation_sd),
        ]
        self._weights = np.concatenate(weights)
        self.nv = int(model.nv)
        self.root = np.arange(6 if self.floating else 0)
        self.still = np.zeros(self.nv, dtype=bool)

    def neutral(self) -> FloatArray:
        """The model's zero configuration (nq,)."""
        import pinocchio as pin

        return np.asarray(pin.neutral(self.model))

    def _points(
        self, links: Sequence[str], position: FloatArray, names: Sequence[str]
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Joint that carries each point, where the point is in the joint's frame, and how the link is turned in it."""
        import pinocchio as pin

        frames = {
            str(f.name): f
            for f in self.model.frames
            if f.type in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT)
        }
        joints, at, turn = [], [], []
        for link, local, name in zip(links, position, names, strict=True):
            if link not in frames:
                raise InputError(
                    f"link of {name}", "a link of the model", repr(link), close_matches(link, frames)
                )
            frame = frames[link]
            joints.append(int(frame.parentJoint))
            at.append(np.asarray(frame.placement.act(local)))
            turn.append(np.asarray(frame.placement.rotation))
        return (
            np.array(joints, dtype=np.intp),
            np.array(at).reshape(-1, 3),
            np.array(turn).reshape(-1, 3, 3),
        )

    def forward(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Joint orientations (n, joints, 3, 3), positions (n, joints, 3), and Jacobians (n, 6, nv) about the world's origin."""
        import pinocchio as pin

        count = q.shape[0]
        H = np.empty((count, self.model.njoints, 4, 4))
        J = np.empty((count, 6, self.model.nv))
        for f in range(count):
            J[f] = pin.computeJointJacobians(self.model, self._data, q[f])
            for i, placement in enumerate(self._data.oMi):
                H[f, i] = placement.homogeneous
        return H[..., :3, :3], H[..., :3, 3], J

    def markers(self, q: FloatArray) -> FloatArray:
        """Positions (n, m, 3) of the markers in the world."""
        R, p, _ = self.forward(q)
        at = self._marker_frames
        return np.asarray(p[:, at] + rotate(R[:, at], self._marker_at))

    def poses(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``R_w_l`` (n, k, 3, 3) and origins (n, k, 3) of the links whose poses are measured."""
        R, p, _ = self.forward(q)
        at = self._pose_frames
        return R[:, at] @ self._pose_turn, np.asarray(p[:, at] + rotate(R[:, at], self._pose_at))

    def link_axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``R_w_l`` (n, m, 3, 3) and origin (n, m, 3) of the link of every marker."""
        R, p, _ = self.forward(q)
        at = self._marker_frames
        return R[:, at] @ self._marker_turn, np.asarray(p[:, at] + rotate(R[:, at], self._marker_origin))

    def residuals(self, q: FloatArray, frames: Any = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n, rows) and Jacobians (n, rows, nv); both zero where nothing was seen."""
        seen = self.observations
        R, p, J = self.forward(q)
        count = q.shape[0]
        points = np.concatenate([self._marker_frames, self._pose_frames])
        at = np.concatenate([self._marker_at, self._pose_at])
        where = p[:, points] + rotate(R[:, points], at)
        measured = seen.markers[frames]
        poses = None
        if seen.posed:
            measured = np.concatenate([measured, seen.p[frames]], axis=1)
            poses = seen.R[frames]
        mask = self._support[points]
        # Velocity of a point: that at the world's origin, and the turning about it.
        columns = np.swapaxes(J, 1, 2)
        moved = columns[:, None, :, :3] + np.cross(columns[:, None, :, 3:], where[:, :, None, :])
        moved *= mask[None, :, :, None]
        r = [(where - measured).reshape(count, -1)]
        D = [np.swapaxes(moved, 2, 3).reshape(count, 3 * points.size, self.model.nv)]
        if poses is not None:
            R_l = R[:, self._pose_frames] @ self._pose_turn
            r.append(lie.so3_log((np.swapaxes(poses, -1, -2) @ R_l).reshape(-1, 3, 3)).reshape(count, -1))
            turned = np.swapaxes(R_l, -1, -2) @ np.where(
                self._support[self._pose_frames][None, :, None, :], J[:, None, 3:], 0.0
            )
            D.append(turned.reshape(count, -1, self.model.nv))
        residual, jacobian = np.concatenate(r, axis=1), np.concatenate(D, axis=1)
        if self.floating:
            # World axes for the free-flyer's translation.
            jacobian[..., :3] = jacobian[..., :3] @ np.swapaxes(R[:, 1], 1, 2)
        lost = ~np.isfinite(residual)
        residual = np.where(lost, 0.0, residual) * self._weights
        jacobian *= np.where(lost, 0.0, self._weights)[..., None]
        return residual, jacobian

    def step(self, q: FloatArray, d: FloatArray) -> FloatArray:
        """Configurations (n, nq) after steps (n, nv)."""
        out = q.copy()
        for i in range(1, self.model.njoints):
            joint = self.model.joints[i]
            iq, iv, nq, nv = int(joint.idx_q), int(joint.idx_v), int(joint.nq), int(joint.nv)
            if nq == nv:
                out[:, iq : iq + nq] += d[:, iv : iv + nv]
                continue
            if nv == 6:
                out[:, iq : iq + 3] += d[:, iv : iv + 3]
                iq, iv = iq + 3, iv + 3
            elif nv != 3:
                raise InputError("model", "hinges, sliders, ball joints and a free-flyer", joint.shortname())
            wxyz = np.roll(q[:, iq : iq + 4], 1, axis=1)
            turned = lie.quaternion_multiply_wxyz(wxyz, lie.quaternion_exp_wxyz(d[:, iv : iv + 3]))
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            out[:, iq : iq + 4] = np.roll(turned, -1, axis=1)
        return out

    def difference(self, q0: FloatArray, q1: FloatArray) -> FloatArray:
        """The step (n, nv) from q0 to q1."""
        out = np.zeros((q0.shape[0], self.model.nv))
        for i in range(1, self.model.njoints):
            joint = self.model.joints[i]
            iq, iv, nq, nv = int(joint.idx_q), int(joint.idx_v), int(joint.nq), int(joint.nv)
            if nq == nv:
                out[:, iv : iv + nv] = q1[:, iq : iq + nq] - q0[:, iq : iq + nq]
                continue
            if nv == 6:
                out[:, iv : iv + 3] = q1[:, iq : iq + 3] - q0[:, iq : iq + 3]
                iq, iv = iq + 3, iv + 3
            a, b = (np.roll(x[:, iq : iq + 4], 1, axis=1) for x in (q0, q1))
            out[:, iv : iv + 3] = lie.quaternion_log_wxyz(
                lie.quaternion_multiply_wxyz(lie.quaternion_conjugate(a), b)
            )
        return out

    def starts(self, frame: int, rest: FloatArray) -> list[FloatArray]:
        """Where to start from nothing: the whole body in its posture, laid onto what is seen in a frame."""
        q = rest[None].copy()
        if self.floating:
            seen = self.observations
            here, there = self.markers(q)[0], seen.markers[frame]
            if seen.posed:
                R, p = self.poses(q)
                tips = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
                here = np.concatenate([here, (p[0][:, None] + tips @ np.swapaxes(R[0], 1, 2)).reshape(-1, 3)])
                measured = seen.p[frame][:, None] + tips @ np.swapaxes(seen.R[frame], 1, 2)
                there = np.concatenate([there, measured.reshape(-1, 3)])
            both = np.isfinite(there).all(axis=1)
            R_w_b, p_w_b = _align(here[both], there[both])
            root = lie.quaternion_wxyz_to_matrix(np.roll(q[:, 3:7], 1, axis=1))[0]
            q[0, :3] = R_w_b @ q[0, :3] + p_w_b
            q[0, 3:7] = np.roll(lie.matrix_to_quaternion_wxyz((R_w_b @ root)[None])[0], -1)
        return [q[0]]

    def nearest(self, q: FloatArray, rest: FloatArray) -> FloatArray:
        """The same orientations with the angles nearest to the posture: three hinges about x, y and z have two sets of them."""
        model = self.model
        out = q.copy()
        hinges = [
            i
            for i in range(1, model.njoints)
            if model.joints[i].nq == 1 and "P" not in model.joints[i].shortname()[10:]
        ]
        at = {i: int(model.joints[i].idx_q) for i in hinges}
        for k in at.values():
            out[:, k] -= 2.0 * np.pi * np.round((out[:, k] - rest[k]) / (2.0 * np.pi))
        for a, b, c in zip(hinges, hinges[1:], hinges[2:], strict=False):
            names = [model.joints[i].shortname().removeprefix("JointModel") for i in (a, b, c)]
            together = all(
                model.parents[low] == high
                and np.allclose(model.jointPlacements[low].homogeneous, np.eye(4), atol=1e-9)
                for high, low in ((a, b), (b, c))
            )
            if not together or len(set(names)) != 3 or not set(names) <= {"RX", "RY", "RZ"}:
                continue
            three = [at[a], at[b], at[c]]
            x, y, z = out[:, three].T
            other = np.column_stack([x + np.pi, np.pi - y, z + np.pi])
            other -= 2.0 * np.pi * np.round((other - rest[three]) / (2.0 * np.pi))
            nearer = np.abs(other - rest[three]).sum(axis=1) < np.abs(out[:, three] - rest[three]).sum(axis=1)
            out[:, three] = np.where(nearer[:, None], other, out[:, three])
        return out

    def limits(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far (n, nv) hinges are beyond their limits, and the information (n, nv) that pulls them back."""
        model = self.model
        beyond = np.zeros((q.shape[0], model.nv))
        for i in range(1, model.njoints):
            joint = model.joints[i]
            if joint.nq != 1:
                continue
            iq, iv = int(joint.idx_q), int(joint.idx_v)
            low, high = float(model.lowerPositionLimit[iq]), float(model.upperPositionLimit[iq])
            if not low < high or high - low > 2.0 * np.pi - 1e-6:
                continue
            x = q[:, iq]
            beyond[:, iv] = np.maximum(x - high, 0.0) + np.minimum(x - low, 0.0)
        return beyond, np.where(beyond != 0.0, LIMIT_SD**-2, 0.0)

    def derivatives(self, q: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Velocities and accelerations (n, nv) of uniform configurations by central differences, as pinocchio has them."""
        steps = self.difference(q[:-1], q[1:])
        v, a = np.zeros((len(q), self.model.nv)), np.zeros((len(q), self.model.nv))
        v[1:-1] = 0.5 * (steps[1:] + steps[:-1]) / dt
        a[1:-1] = (steps[1:] - steps[:-1]) / dt**2
        v[[0, -1]], a[[0, -1]] = v[[1, -2]], a[[1, -2]]
        if self.floating:
            wxyz = np.roll(q[:, 3:7], 1, axis=1)
            _, v[:, :6], a[:, :6] = free_flyer(q[:, :3], wxyz, v[:, :3], v[:, 3:6], a[:, :3], a[:, 3:6])
        return v, a


def _align(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R, p with ``b = R a + p`` (Kabsch)."""
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    U, _, V = np.linalg.svd((b - cb).T @ (a - ca))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return R, cb - R @ ca


def placement_of(markers: Mapping[str, tuple[str, Sequence[float], float]]) -> Placement:
    """A placement from marker name to (link, position in its frame, sd)."""
    rows = list(markers.values())
    return Placement(
        tuple(markers),
        tuple(row[0] for row in rows),
        np.array([row[1] for row in rows], dtype=float).reshape(-1, 3),
        np.array([row[2] for row in rows], dtype=float),
    )
