"""The peer: OpenSim's InverseDynamicsTool on the frames that we are given."""

from __future__ import annotations

import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgrasp.typing import FloatArray


@dataclass(frozen=True)
class OpenSimResult:
    """Generalised forces.

    Attributes
    ----------
    t : ndarray
        (n,) s.
    force : dict of str to ndarray
        By coordinate, Nm or N.
    seconds : float
        Processor time of the tool's run, the reading of its model left out.
    """

    t: FloatArray
    force: dict[str, FloatArray]
    seconds: float


def inverse_dynamics(
    model: Path, loads: Path, forces: Path, t: FloatArray, coordinates: dict[str, FloatArray]
) -> OpenSimResult:
    """Run the tool on coordinates (rad and m) at `t`, without its filter.

    Raises
    ------
    ModuleNotFoundError
        Where OpenSim is not installed.
    RuntimeError
        When the tool does not run.
    """
    import opensim as osim

    osim.Logger.setLevelString("Off")
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        table = np.column_stack([t, *coordinates.values()])
        lines = [
            "Coordinates",
            "version=1",
            f"nRows={len(t)}",
            f"nColumns={table.shape[1]}",
            "inDegrees=no",
            "endheader",
        ]
        lines.append("\t".join(["time", *coordinates]))
        lines += ["\t".join(f"{v:.12g}" for v in row) for row in table]
        (here / "coordinates.mot").write_text("\n".join(lines) + "\n")
        text = re.sub(
            r"<datafile>.*?</datafile>", f"<datafile>{forces.resolve()}</datafile>", loads.read_text()
        )
        if not text.rstrip().endswith("</OpenSimDocument>"):
            text += "</OpenSimDocument>"
        (here / "loads.xml").write_text(text)
        body = osim.Model(str(model.resolve()))
        tool = osim.InverseDynamicsTool()
        tool.setModel(body)
        tool.setCoordinatesFileName(str(here / "coordinates.mot"))
        tool.setExternalLoadsFileName(str(here / "loads.xml"))
        tool.setLowpassCutoffFrequency(-1.0)
        tool.setStartTime(float(t[0]))
        tool.setEndTime(float(t[-1]))
        tool.setResultsDir(str(here))
        tool.setOutputGenForceFileName("forces.sto")
        left_out = osim.ArrayStr()
        left_out.append("Muscles")
        tool.setExcludedForces(left_out)
        started = time.process_time()
        if not tool.run():
            raise RuntimeError("OpenSim's InverseDynamicsTool did not run")
        seconds = time.process_time() - started
        found = osim.TimeSeriesTable(str(here / "forces.sto"))
        times = np.array(found.getIndependentColumn())
        values = {
            re.sub(r"_(moment|force)$", "", name): found.getDependentColumn(name).to_numpy().copy()
            for name in found.getColumnLabels()
        }
    return OpenSimResult(times, values, seconds)
