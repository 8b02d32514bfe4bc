"""The typed answer to a segmented grasp problem: the grasp over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from factorgrasp import lie
from factorgrasp.estimate import Estimate, TermSummary
from factorgrasp.problems.grasp_estimate import GraspPoseEstimate
from factorgrasp.problems.grasp_view import EstimateView
from factorgrasp.typing import FloatArray, JsonDict, State

if TYPE_CHECKING:
    from factorgrasp.problems.grasp_segments import GraspSegments


@dataclass(frozen=True)
class GraspTrack(EstimateView):
    """Where the human grasped, segment by segment.

    Attributes
    ----------
    estimate : Estimate
        The general answer with all unknowns.
    t : (K,) ndarray
        Mean time of every segment, s, robot clock; of the whole recording when the grasp is static.
    rotation : (K, 3, 3) ndarray
        ``R_r_h``, hand to end-effector.
    translation : (K, 3) ndarray
        ``p_r_h``, hand origin in the end-effector frame, m.
    covariance : (K, 6, 6) ndarray
        Order [rotation; translation]; rotation as right perturbation of ``R_r_h``, rad and m. NaN where there is none.
    time_offset : float
        s, hand clock minus robot clock.
    nodes : tuple of (str, str)
        Names of every segment's rotation and translation in `estimate`.
    problem : GraspSegments
        As it was posed last, with the clocks and weights that the data settled: for its graph and increments.
    state : mapping
        Solution of `problem` (the time offset in it is what remains beyond that of its clocks).
    """

    estimate: Estimate
    t: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    time_offset: float
    nodes: tuple[tuple[str, str], ...]
    problem: GraspSegments = field(repr=False, compare=False)
    state: State = field(repr=False, compare=False)

    @classmethod
    def from_estimate(
        cls, estimate: Estimate, problem: GraspSegments, nodes: Sequence[tuple[str, str]], time_offset: float
    ) -> GraspTrack:
        """Typed view of a solver's answer to a grasp that wanders; `time_offset` (s) is the whole one."""
        covariance = np.full((len(nodes), 6, 6), np.nan)
        if estimate.covariance_source is not None:
            for k, names in enumerate(nodes):
                covariance[k] = estimate.covariance(*names)
        values = dict(estimate.values)
        if "time_offset" in values:
            values["time_offset"] = np.array([time_offset])
        numbers = np.array([factor.moments.numbers for factor in problem.factors])
        residuals = tuple(_counted(term, numbers) for term in estimate.residuals)
        return cls(
            estimate=replace(estimate, values=values, residuals=residuals),
            t=problem.t,
            rotation=np.stack([values[rotation] for rotation, _ in nodes]),
            translation=np.stack([values[translation] for _, translation in nodes]),
            covariance=covariance,
            time_offset=time_offset,
            nodes=tuple(nodes),
            problem=problem,
            state=estimate.values,
        )

    @classmethod
    def from_pose(cls, pose: GraspPoseEstimate, problem: GraspSegments, state: State) -> GraspTrack:
        """The answer to the unsegmented problem as a track of one node."""
        return cls(
            estimate=pose.estimate,
            t=np.array([problem.t.mean()]),
            rotation=pose.rotation[None],
            translation=pose.translation[None],
            covariance=pose.covariance[None],
            time_offset=pose.time_offset,
            nodes=(("rotation", "translation"),),
            problem=problem,
            state=state,
        )

    @property
    def log_evidence(self) -> float:
        """How well the width of the walk explains the data; see :meth:`GraspSegments.log_evidence`."""
        return self.problem.log_evidence(self.state)

    def change(self, first: int = 0, last: int = -1) -> tuple[FloatArray, FloatArray]:
        """How the grasp moved from one segment to another.

        Returns
        -------
        change : (6,) ndarray
            ``[Log(R_first' R_last); p_last - p_first]``, rad and m.
        covariance : (6, 6) ndarray
            Of the change, correlations between the segments included.
        """
        turn = self.rotation[first].T @ self.rotation[last]
        vector = lie.so3_log(turn)
        J_last = lie.so3_right_jacobian_inverse(vector)
        columns = self.estimate.size
        readout = np.zeros((6, columns))
        start = 0
        parts = {
            self.nodes[first][0]: (slice(0, 3), -J_last @ turn.T),
            self.nodes[last][0]: (slice(0, 3), J_last),
            self.nodes[first][1]: (slice(3, 6), -np.eye(3)),
            self.nodes[last][1]: (slice(3, 6), np.eye(3)),
        }
        for variable in self.estimate.variables:
            if variable.name in parts:
                rows, block = parts[variable.name]
                readout[rows, start : start + 3] += block
            start += variable.size
        change = np.concatenate([vector, self.translation[last] - self.translation[first]])
        return change, self.estimate.readout_covariance(readout)

    def summary(self) -> str:
        """A few lines for a terminal."""
        lines = [
            f"grasp over time: {self.status.value} by {self.estimate.solver}, {self.t.size} segment{'s' * (self.t.size > 1)}"
        ]
        lines.append(
            "     t [s]   turned since the first [deg]      translation p_r_h [mm]       sd [deg]  sd [mm]"
        )
        for k in np.unique(np.linspace(0, self.t.size - 1, min(self.t.size, 15)).astype(int)):
            turned = np.degrees(lie.so3_log(self.rotation[0].T @ self.rotation[k]))
            sd = np.sqrt(np.diag(self.covariance[k]))
            lines.append(
                f"  {self.t[k]:8.2f}   {_triple(turned, 3):>28}   {_triple(1e3 * self.translation[k], 2):>28}"
                f"   {np.degrees(sd[:3].max()):8.3f} {1e3 * sd[3:].max():8.2f}"
            )
        lines.append(f"  time offset {1e3 * self.time_offset:.3f} ms")
        if self.message and not self.estimate.solved:
            lines.append(f"  {self.message}")
        return "\n".join(lines)

    def to_dict(self) -> JsonDict:
        """The content of ``estimate.json``."""
        out = self.estimate.to_dict()
        out["track"] = {
            "t": self.t.tolist(),
            "rotation_wxyz": lie.matrix_to_quaternion_wxyz(self.rotation, continuous=True).tolist(),
            "translation": self.translation.tolist(),
            "covariance": self.covariance.tolist(),
            "time_offset": self.time_offset,
        }
        return out

    def arrays(self) -> dict[str, FloatArray]:
        """The content of ``estimate.npz``."""
        return {
            "t": self.t,
            "rotation": self.rotation,
            "rotation_wxyz": lie.matrix_to_quaternion_wxyz(self.rotation, continuous=True),
            "translation": self.translation,
            "covariance": self.covariance,
        }

    def save(self, directory: str | Path) -> Path:
        """Write ``estimate.json`` and ``estimate.npz`` atomically; returns the JSON's path."""
        from factorgrasp.results import write_result

        return write_result(Path(directory), self.to_dict(), self.arrays())


def _counted(term: TermSummary, numbers: FloatArray) -> TermSummary:
    """The summary of the moments in independent numbers of the recording, not in compressed rows."""
    if term.name != "moments":
        return term
    # Rows hold the number of independent numbers as a constant; see SegmentFactor.offset.
    total = float(numbers.sum())
    chi2 = max(term.chi2 - total, 0.0)
    worst = np.sqrt(max(term.worst**2 / float(np.median(numbers)) - 1.0, 0.0))
    return replace(term, rows=round(total), chi2=chi2, rms=float(np.sqrt(chi2 / total)), worst=float(worst))


def _triple(values: FloatArray, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)
