"""A segmented grasp problem as a gtsam graph: one moment factor a segment, the walk and the priors.

Keys are ``r<k>`` (Rot3, ``R_r_h`` of segment k), ``p<k>`` (vector, ``p_r_h``) and ``c0`` (vector, all shared
unknowns one after another). gtsam is imported when a graph is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.problems.grasp_settings import GraspPrior
from factorgrasp.typing import FloatArray, State
from factorgrasp.variables import Variable, slices

if TYPE_CHECKING:
    from factorgrasp.problems.grasp_segment_factor import SegmentFactor

Increment = tuple[list[Any], Any, dict[int, float]]
"""Factors, new values (or a function of the known values that makes them), and stamps by key."""


@dataclass(frozen=True)
class SegmentKeys:
    """The gtsam keys that a segment sees, and how to read its state from ``gtsam.Values``.

    Attributes
    ----------
    shared : tuple of Variable
        The unknowns that all segments share, in the order of the vector ``c0``.
    static : bool
        All segments see the grasp of the first.
    """

    shared: tuple[Variable, ...]
    static: bool

    def of(self, k: int) -> tuple[int, ...]:
        """Keys of segment k, packed as gtsam packs symbols: the letter in the highest byte."""
        index = 0 if self.static else k
        grasp = ((ord("r") << 56) + index, (ord("p") << 56) + index)
        return (*grasp, ord("c") << 56) if self.shared else grasp

    def reader(self, k: int) -> Callable[[Any], State]:
        """From ``gtsam.Values`` to what segment k sees, in the names of the unsegmented problem."""
        keys, where = self.of(k), slices(self.shared)

        def read(values: Any) -> dict[str, FloatArray]:
            out = {"rotation": values.atRot3(keys[0]).matrix(), "translation": values.atVector(keys[1])}
            if where:
                shared = values.atVector(keys[2])
                out.update({name: shared[part] for name, part in where.items()})
            return out

        return read


@dataclass(frozen=True)
class SegmentGraph:
    """What the graph is made of.

    Attributes
    ----------
    keys : SegmentKeys
    factors : sequence of SegmentFactor
    t : (K,) ndarray
        Time of every segment, s.
    rotation_walk_sd, translation_walk_sd : float
        rad/sqrt(s) and m/sqrt(s).
    prior : GraspPrior
    precision : (n,) ndarray
        Of the priors on what a segment sees.
    """

    keys: SegmentKeys
    factors: Sequence[SegmentFactor]
    t: FloatArray
    rotation_walk_sd: float
    translation_walk_sd: float
    prior: GraspPrior
    precision: FloatArray

    @property
    def nodes(self) -> int:
        """Number of different grasps."""
        return 1 if self.keys.static else len(self.factors)

    def graph(self) -> Any:
        """``gtsam.NonlinearFactorGraph`` with one ``CustomFactor`` a segment."""
        import gtsam

        graph = gtsam.NonlinearFactorGraph()
        for k, factor in enumerate(self.factors):
            graph.push_back(factor.custom())
            for tie in self._ties(k):
                graph.push_back(tie)
        return graph

    def values(self, local: Callable[[int], State]) -> Any:
        """``gtsam.Values`` from what every segment sees."""
        import gtsam

        out = gtsam.Values()
        for k in range(self.nodes):
            keys, state = self.keys.of(k), local(k)
            out.insert(keys[0], gtsam.Rot3(np.asarray(state["rotation"])))
            out.insert(keys[1], np.asarray(state["translation"], dtype=float))
            if k == 0 and self.keys.shared:
                out.insert(keys[2], np.concatenate([state[v.name] for v in self.keys.shared]))
        return out

    def increments(self, start: Any) -> Iterator[Increment]:
        """The graph segment by segment; `start` (gtsam.Values) holds the first segment's grasp and ``c0``."""
        import gtsam

        for k, factor in enumerate(self.factors):
            keys = self.keys.of(k)
            new: Any = gtsam.Values()
            if k == 0:
                new.insert(keys[0], start.atRot3(keys[0]))
                for key in keys[1:]:
                    new.insert(key, start.atVector(key))
            elif not self.keys.static:
                new = _continuation(self.keys.of(k - 1), keys)
            yield [factor, *self._ties(k)], new, {key: float(self.t[k]) for key in keys}

    def _ties(self, k: int) -> list[Any]:
        """Priors of the first segment; the walk that ties any other to the one before."""
        if k == 0:
            return self._priors()
        if self.keys.static:
            return []
        import gtsam

        root = float(np.sqrt(self.t[k] - self.t[k - 1]))
        turn = gtsam.noiseModel.Isotropic.Sigma(3, self.rotation_walk_sd * root)
        way = gtsam.noiseModel.Isotropic.Sigma(3, self.translation_walk_sd * root)
        before, after = self.keys.of(k - 1), self.keys.of(k)
        return [
            gtsam.BetweenFactorRot3(before[0], after[0], gtsam.Rot3(), turn),
            gtsam.BetweenFactorVector(before[1], after[1], np.zeros(3), way),
        ]

    def _priors(self) -> list[Any]:
        import gtsam

        keys, diagonal = self.keys.of(0), gtsam.noiseModel.Diagonal.Precisions
        mean = gtsam.Rot3() if self.prior.rotation is None else gtsam.Rot3(self.prior.rotation)
        out = [
            gtsam.PriorFactorRot3(keys[0], mean, diagonal(self.precision[0:3])),
            gtsam.PriorFactorVector(keys[1], self.prior.translation, diagonal(self.precision[3:6])),
        ]
        if self.keys.shared:
            shared = self.precision[6:]
            out.append(gtsam.PriorFactorVector(keys[2], np.zeros(shared.size), diagonal(shared)))
        return out


def _continuation(before: tuple[int, ...], after: tuple[int, ...]) -> Callable[[Any], Any]:
    """A new segment starts at the grasp of the one before."""

    def values(known: Any) -> Any:
        import gtsam

        out = gtsam.Values()
        out.insert(after[0], known.atRot3(before[0]))
        out.insert(after[1], known.atVector(before[1]))
        return out

    return values
