"""What solving a wrist recording gives back, and the files that it writes."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.kinematics.angles import ISB_NAMES, Hand
from factorgrasp.kinematics.wrist_measures import WristMeasures
from factorgrasp.models.camera import Camera
from factorgrasp.problems.wrist_estimate import WristPoseEstimate
from factorgrasp.problems.wrist_track import WristTrack
from factorgrasp.recordings.blobs import BlobRecording
from factorgrasp.status import Status
from factorgrasp.typing import IntArray, JsonDict

TRACK_NAME = "estimate.csv"

_CORNERS = [(i, j) for i in range(6) for j in range(i, 6)]


@dataclass(frozen=True, eq=False)
class WristResult:
    """The answer to a :class:`factorgrasp.wrist_task.WristTask`.

    Attributes
    ----------
    estimate : Estimate
        Status, agreement with the noise model, timing and provenance.
    solved : WristPoseEstimate
        Track, layout, rates.
    measures : WristMeasures
        Angles, ranges of motion, movements.
    blobs : BlobRecording
    camera : Camera
    hand : {"right", "left"}
    method : {"batch", "fixed_lag", "filter"}
    warnings : tuple of str
        What a user should know.
    """

    estimate: Estimate
    solved: WristPoseEstimate
    measures: WristMeasures
    blobs: BlobRecording
    camera: Camera
    hand: Hand = "right"
    method: str = "batch"
    warnings: tuple[str, ...] = ()

    extra_files = (TRACK_NAME,)

    @property
    def track(self) -> WristTrack:
        """Pose over time."""
        return self.solved.track

    @property
    def status(self) -> Status:
        """`Status.SOLVED` when the hand was tracked, and its pose is not ambiguous."""
        return self.estimate.status

    @property
    def message(self) -> str:
        """Why not, otherwise."""
        return self.estimate.message

    @cached_property
    def markers_seen(self) -> IntArray:
        """(n,) markers that were used in every frame."""
        used = self.track.association > 0
        return np.bincount(self.blobs.frame[used], minlength=len(self.blobs))

    def arrays(self) -> dict[str, Any]:
        """What ``estimate.npz`` holds."""
        track, start = self.track, self.track.camera_pose
        return {
            "t": track.t,
            "rotation_wxyz": track.rotation_wxyz,
            "position": track.position,
            "velocity": track.velocity,
            "angular_velocity": track.angular_velocity,
            "covariance": track.covariance,
            "velocity_covariance": track.velocity_covariance,
            "association": track.association,
            "blob_frame": self.blobs.frame,
            "blob_uv": self.blobs.uv,
            "blob_depth": self.blobs.depth,
            "lost": track.lost,
            "ambiguous": track.ambiguous,
            "markers_seen": self.markers_seen,
            "angles": self.measures.angles,
            "angles_sd": self.measures.angles_sd,
            "angle_names": np.array(ISB_NAMES),
            "layout": track.markers.points,
            "layout_covariance": track.markers.covariance,
            "marker_names": np.array(track.markers.names),
            "camera_rotation_wxyz": lie.matrix_to_quaternion_wxyz(start.rotation),
            "camera_position": start.position,
            "camera_covariance": start.covariance,
        }

    def to_dict(self) -> JsonDict:
        """The summary that ``estimate.json`` holds."""
        from factorgrasp.estimate_io import to_dict

        # A track has hundreds of variables, which are in the arrays.
        bare = replace(self.estimate, variables=(), values={}, covariance_source=None)
        out = to_dict(bare)
        for key in ("variables", "multipliers"):
            out.pop(key)
        track, solved = self.track, self.solved
        t = track.t
        sd = self._typical_sd()
        start = track.camera_pose
        out |= {
            "units": "rad, m, s; angles positive in the direction of their names; quaternions [w, x, y, z]",
            "method": self.method,
            "delay": track.delay,
            "frames": {
                "all": len(track),
                "lost": int(track.lost.sum()),
                "ambiguous": int(track.ambiguous.sum()),
                "duration": float(t[-1] - t[0]),
                "markers_seen": float(self.markers_seen.mean()),
            },
            "sd": {"rotation": sd[0], "position": sd[1]},
            **self.measures.to_dict(),
            "layout": {
                "names": list(track.markers.names),
                "points": track.markers.points.tolist(),
                "sd": track.markers.sd.tolist(),
                "covariance": track.markers.covariance.tolist(),
            },
            "rates": {
                "detection": solved.detection,
                "miss": 1.0 - solved.detection,
                "clutter": solved.clutter,
                "pixel_sd": solved.pixel_sd,
                "depth_sd": solved.depth_sd,
            },
            "gaps": [asdict(gap) for gap in track.gaps],
            "camera_pose": {
                "rotation_wxyz": lie.matrix_to_quaternion_wxyz(start.rotation).tolist(),
                "position": np.asarray(start.position).tolist(),
                "covariance": np.asarray(start.covariance).tolist(),
                "frames": start.frames,
            },
            "warnings": list(self.warnings),
        }
        return out

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json``, ``estimate.npz`` and ``estimate.csv`` into `directory`, each atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        self.export(folder / TRACK_NAME)
        return write_result(folder, self.to_dict(), self.arrays())

    def table(self) -> dict[str, Any]:
        """Columns by name, one row a frame.

        ``t``; ``px..pz`` and ``qw..qz`` (as a recording of poses has them); ``vx..vz`` in W0; ``wx..wz`` in W; the angles with ``_sd``;
        ``cov_ij``, the upper triangle of the covariance [rotation; translation]; ``association``, the marker of every blob of the frame
        in its order (0: clutter), with spaces between; ``markers``, ``lost``, ``ambiguous``.
        """
        track = self.track
        out: dict[str, Any] = {"t": track.t}
        for names, values in (
            (("px", "py", "pz"), track.position),
            (("qw", "qx", "qy", "qz"), track.rotation_wxyz),
            (("vx", "vy", "vz"), track.velocity),
            (("wx", "wy", "wz"), track.angular_velocity),
            (ISB_NAMES, self.measures.angles),
            (tuple(f"{name}_sd" for name in ISB_NAMES), self.measures.angles_sd),
        ):
            out |= {name: values[:, k] for k, name in enumerate(names)}
        out |= {f"cov_{i}{j}": track.covariance[:, i, j] for i, j in _CORNERS}
        rows = [track.association[self.blobs.rows(k)] for k in range(len(self.blobs))]
        out["association"] = np.array([" ".join(map(str, row)) for row in rows], dtype=object)
        out["markers"] = self.markers_seen
        out["lost"], out["ambiguous"] = track.lost.astype(int), track.ambiguous.astype(int)
        return out

    def export(self, path: str | Path) -> Path:
        """Write :meth:`table` as .csv or .parquet (needs pyarrow), atomically; returns the path."""
        return export_table(Path(path), self.table())

    def summary(self) -> str:
        """A few lines for a terminal."""
        from factorgrasp.report import quantity, significant

        track = self.track
        lines = [
            f"wrist pose, {self.method.replace('_', ' ')}: {self.status.value}; {len(track)} frames, {track.t[-1] - track.t[0]:.1f} s, "
            f"{self.markers_seen.mean():.1f} of {len(track.markers)} markers seen"
        ]
        if self.message:
            lines.append(self.message)
        # What an answer that is none says of the hand is not for printing.
        for one in self.measures.range_of_motion if self.status.ok else ():
            (up, most), (down, least) = zip(
                one.directions, (one.maximum.value, -one.minimum.value), strict=True
            )
            axis, cycles = (
                one.axis.replace("_", "/", 1).replace("_", " "),
                "cycle" if one.cycles == 1 else "cycles",
            )
            lines.append(
                f"  {axis:<24}{np.degrees(one.range.value):6.1f} deg +- {np.degrees(one.range.sd):.1f}   ({up.replace('_', ' ')} "
                f"{np.degrees(most):.1f}, {down.replace('_', ' ')} {np.degrees(least):.1f}; {one.cycles} {cycles})"
            )
        for move in self.measures.movements if self.status.ok else ():
            way = f"{quantity(move.distance.value, 'm', 3)} +- {quantity(move.distance.sd, 'm')}"
            lines.append(
                f"  movement {move.start:6.2f} to {move.end:.2f} s: {way}, peak {significant(move.peak_speed.value, 3)} m/s, "
                f"straightness {move.straightness.value:.3f}"
            )
        sd = self._typical_sd()
        if np.isfinite(sd[0]):
            lines.append(f"  typical sd {np.degrees(sd[0]):.2f} deg, {1e3 * sd[1]:.2f} mm")
        lines.append(
            f"  a marker is missed {100.0 * (1.0 - self.solved.detection):.1f} % of the time; "
            f"{self.solved.clutter:.2f} blobs a frame are none"
        )
        for gap in track.gaps:
            end = "the track was lost" if gap.lost else "bridged"
            if gap.found is not None and gap.lost:
                end += f" and found again at {gap.found:.2f} s"
            if gap.frames > 2:
                lines.append(
                    f"  no marker from {gap.start:.2f} to {gap.end:.2f} s ({gap.frames} frames): {end}"
                )
        lines += [f"note: {words}" for words in self.warnings]
        return "\n".join(lines)

    def _typical_sd(self) -> tuple[float, float]:
        """Root of the median mean variance of rotation (rad) and position (m)."""
        P = self.track.covariance
        P = P[np.isfinite(P).all(axis=(1, 2))]
        if not len(P):
            return float("nan"), float("nan")
        trace = np.einsum("nii->ni", P)
        return (
            float(np.sqrt(np.median(trace[:, :3].mean(axis=1)))),
            float(np.sqrt(np.median(trace[:, 3:].mean(axis=1)))),
        )


def export_table(file: Path, columns: dict[str, Any]) -> Path:
    """Write columns as .csv or .parquet (needs pyarrow), atomically; returns the path. NaN is an empty cell in CSV."""
    from factorgrasp.atomic import replacing, write_text

    suffix = file.suffix.lower()
    if suffix == ".parquet":
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError as error:
            raise InputError(
                str(file), "pyarrow, which writes Parquet", "none", "pip install 'factorgrasp[data]'"
            ) from error
        with replacing(file) as temporary:
            parquet.write_table(pyarrow.table(columns), temporary)
        return file
    if suffix != ".csv":
        raise InputError(str(file), "a name that ends in .csv or .parquet", file.suffix or "no ending")
    texts = [list(map(_cell, np.asarray(values).tolist())) for values in columns.values()]
    lines = [",".join(columns), *(",".join(row) for row in zip(*texts, strict=True))]
    return write_text(file, "\n".join(lines) + "\n")


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if np.isfinite(value) else ""
    return str(value)
