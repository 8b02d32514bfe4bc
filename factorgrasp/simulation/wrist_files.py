"""A simulated wrist recording as files: the blobs, the truth, and a problem file that points at them."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from os import PathLike
from pathlib import Path

import numpy as np

from factorgrasp.atomic import replacing, write_text
from factorgrasp.recordings.blobs import write_blobs
from factorgrasp.results import finite
from factorgrasp.simulation.wrist import WristRecording


def write_wrist_recording(
    recording: WristRecording, directory: str | PathLike[str], labels: bool = False
) -> Path:
    """Write ``blobs.csv``, ``truth.npz``, ``truth.json`` and ``wrist.toml``, each atomically.

    Parameters
    ----------
    recording : WristRecording
    directory : path
        Made if missing; files of these names in it are replaced.
    labels : bool
        Whether ``blobs.csv`` has the column `label` with the true marker of every blob; no estimator reads it.

    Returns
    -------
    Path
        Of ``wrist.toml``.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    truth, camera, blobs = recording.truth, recording.camera, recording.blobs
    write_blobs(folder / "blobs.csv", blobs if labels else replace(blobs, label=None))
    arrays = {
        "t": truth.t,
        "rotation_wxyz": truth.rotation_wxyz,
        "position": truth.position,
        "velocity": truth.velocity,
        "angular_velocity": truth.angular_velocity,
        "T_c_W0": truth.T_c_W0,
        "points": truth.points,
        "hidden": truth.hidden,
        "arrival": recording.arrival,
        "label": recording.label,
    }
    if truth.angles is not None:
        arrays["angles"] = truth.angles
    with replacing(folder / "truth.npz") as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its stubs take the options for names, too
    record = {
        "name": recording.name,
        "hand": recording.hand,
        "sensing": asdict(recording.sensing),
        "camera": asdict(truth.camera),
        "layout": truth.points.tolist(),
    }
    write_text(folder / "truth.json", json.dumps(finite(record), indent=2) + "\n")
    distortion = f"distortion = {list(camera.distortion)}\n" if camera.distortion else ""
    points = ",\n".join(f"  {[float(x) for x in point]}" for point in recording.layout.points)
    names = ", ".join(f'"{name}"' for name in recording.layout.names)
    depth_sd = "" if recording.sensing.depth_sd is None else f"depth_sd = {recording.sensing.depth_sd!r}\n"
    # Written last: whoever finds it finds the rest.
    target = folder / "wrist.toml"
    write_text(
        target,
        f"# Simulated: {recording.name}. The truth is in truth.npz and truth.json.\n"
        'kind = "wrist_pose"\n\n'
        "[camera]\n"
        f"fx = {camera.fx!r}\nfy = {camera.fy!r}\ncx = {camera.cx!r}\ncy = {camera.cy!r}\n"
        f"resolution = [{camera.width}, {camera.height}]\nrate = {camera.rate!r}\n{distortion}\n"
        '[blobs]\nfile = "blobs.csv"\n\n'
        f"[markers]\nnames = [{names}]\nlayout = [\n{points},\n]\nsd = {float(np.max(recording.layout.sd))!r}\n\n"
        f"[noise]\npixel_sd = {recording.sensing.pixel_sd!r}\n{depth_sd}\n"
        f'[estimate]\nhand = "{recording.hand}"\n',
    )
    return target
