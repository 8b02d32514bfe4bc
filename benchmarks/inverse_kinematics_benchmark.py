"""Inverse kinematics from real markers against OpenSim's own solver: the same model, markers and weights in the same run.

python benchmarks/inverse_kinematics_benchmark.py [--data ../shared/data]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from factorgrasp.body_state import configurations, estimate_state
from factorgrasp.models.osim import OsimModel, read_osim
from factorgrasp.problems.body_observations import BodyObservations, placement_of
from factorgrasp.recordings.opensim import CoordinateTable, read_coordinates, read_trc
from factorgrasp.tables import Column, Table
from factorgrasp.typing import FloatArray

SPAN = (0.4, 1.6)
SD = 0.01


def opensim_solution(
    model: Path, markers: Path, names: list[str], span: tuple[float, float]
) -> tuple[CoordinateTable, float]:
    """OpenSim's InverseKinematicsTool with equal weights, and its processor time (s)."""
    import opensim

    opensim.Logger.setLevelString("Off")
    body = opensim.Model(str(model))  # kept: the tool does not own it
    tool = opensim.InverseKinematicsTool()
    tool.setModel(body)
    tool.setMarkerDataFileName(str(markers))
    tool.setStartTime(span[0])
    tool.setEndTime(span[1])
    tasks = tool.getIKTaskSet()
    for name in names:
        task = opensim.IKMarkerTask()
        task.setName(name)
        task.setApply(True)
        task.setWeight(1.0)
        tasks.cloneAndAppend(task)
    tool.set_accuracy(1e-8)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "ik.mot"
        tool.setOutputMotionFileName(str(out))
        begin = time.process_time()
        tool.run()
        spent = time.process_time() - begin
        return read_coordinates(out), spent


def compare(
    model: OsimModel,
    reference: CoordinateTable,
    t: FloatArray,
    q: FloatArray,
    state: FloatArray,
    sd: FloatArray,
) -> Table:
    """Root mean squares of differences by coordinate, in degrees and millimetres."""
    rows = []
    for k, one in enumerate(model.coordinates):
        if one.locked or one.name not in reference.names:
            continue
        unit = 1000.0 if one.slides else 180.0 / np.pi
        known = np.interp(
            t, reference.t, reference.values[:, reference.names.index(one.name)], np.nan, np.nan
        )
        size = [unit * float(np.sqrt(np.nanmean((x[:, k] - known) ** 2))) for x in (q, state)]
        own = unit * float(np.median(sd[:, k]))
        rows.append(
            {
                "name": one.name,
                "unit": "mm" if one.slides else "deg",
                "single": size[0],
                "smooth": size[1],
                "sd": own,
            }
        )
    columns = (
        Column("name", "coordinate"), Column("unit"), Column("single", "single frames less OpenSim", format=".3f"),
        Column("smooth", "over time less OpenSim", format=".2f"), Column("sd", "stated sd over time", format=".2f"),
    )  # fmt: skip
    return Table(columns, tuple(rows))


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    folder = parser.parse_args().data / "opensim_walk_gait2354"
    model, seen = read_osim(folder / "subject01_simbody.osim"), read_trc(folder / "subject01_walk1.trc")
    names = [name for name in model.markers if name in seen.names]
    reference, spent = opensim_solution(
        folder / "subject01_simbody.osim", folder / "subject01_walk1.trc", names, SPAN
    )
    keep = (seen.t >= SPAN[0] - 0.01) & (seen.t <= SPAN[1] + 0.01)
    t = seen.t[keep]
    t = t[0] + (t[-1] - t[0]) / (t.size - 1) * np.arange(t.size)
    placement = placement_of({name: (*model.markers[name], SD) for name in names})
    observations = BodyObservations(
        placement, seen.position[keep][:, [seen.names.index(name) for name in names]]
    )
    begin = time.process_time()
    q = configurations(model, observations, posture_sd=100.0)
    single = time.process_time() - begin
    begin = time.process_time()
    state = estimate_state(model, t, observations)
    over_time = time.process_time() - begin
    print(
        compare(
            model, reference, t, q, np.where(state.good[:, None], state.q, np.nan), np.sqrt(state.q_variance)
        ).text()
    )
    spents = (
        f"OpenSim {spent:.2f} s, single frames {single:.2f} s, over time with covariances {over_time:.2f} s"
    )
    print(f"{t.size} frames, {len(names)} markers; processor time: {spents}")


if __name__ == "__main__":
    main()
