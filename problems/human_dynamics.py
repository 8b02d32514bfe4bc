"""Human dynamics: joint torques, wrenches and accelerations of an articulated body as one maximum a posteriori estimate a frame.

Model and unknowns: mathematics 4.1 (Latella 2018, Tirupachuri 2021). Newton-Euler, sensors and a prior are rows with
covariances; torques are
linear read-outs with theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares
from factorgrasp.problems.human_dynamics_constraints import DynamicsConstraint
from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate, read_frames
from factorgrasp.problems.human_dynamics_point import measured_wrenches, newton_euler
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_state import state_sensors
from factorgrasp.problems.human_dynamics_system import HumanDynamicsSystem
from factorgrasp.problems.human_dynamics_whitening import Whitening
from factorgrasp.problems.link_motion import LinkKinematics, LinkMotion
from factorgrasp.typing import BoolArray, FloatArray, IntArray


class HumanDynamics:
    """The human-dynamics problem of one recording; solve it with :func:`factorgrasp.solvers.frames.solve_frames`.

    Parameters
    ----------
    motion : LinkMotion
        Fixed or floating base.
    sensors : sequence of Sensor
        Measurements at the frames of the motion; links without a wrench sensor that are not in `contacts` are taken to touch nothing.
    noise : HumanDynamicsNoise
    contacts : sequence of str
        Links that may carry a wrench nobody measures (hands, seat, back).
    constraints : sequence of DynamicsConstraint
        Inequalities on wrenches and torques (mathematics 4.5); need a QP solver.
    hard_dynamics : bool
        Newton-Euler as equality constraints in place of rows with a variance.
    use_motion : bool
        Take the motion's own accelerations as measurements where no sensor gives them.

    Raises
    ------
    InputError
        Naming the sensor, link or variance that does not fit.
    """

    kind = "human_dynamics"

    def __init__(
        self,
        motion: LinkMotion,
        sensors: Sequence[Sensor] = (),
        noise: HumanDynamicsNoise | None = None,
        contacts: Sequence[str] = (),
        constraints: Sequence[DynamicsConstraint] = (),
        hard_dynamics: bool = False,
        use_motion: bool = True,
    ) -> None:
        arguments = (noise, tuple(contacts), hard_dynamics, use_motion)
        self.motion, self.sensors, self.constraints = motion, tuple(sensors), tuple(constraints)
        count = len(motion)
        for sensor in self.sensors:
            if sensor.values.shape[0] != count:
                raise InputError(
                    sensor.name,
                    f"values at the {count} frames of the motion",
                    f"{sensor.values.shape[0]} rows",
                )
        tree = motion.tree
        rows = [constraint.row_pattern(tree) for constraint in self.constraints]
        every, errors = self.sensors, motion.state_noise
        if errors is not None:
            every += state_sensors(tree, errors, motion.kinematics(), self.sensors, use_motion)
            use_motion = use_motion and not errors.gives_accelerations
        self.system = HumanDynamicsSystem(
            tree, every, noise, contacts, use_motion, hard_dynamics, rows, errors is not None
        )
        self._values = (
            np.concatenate([sensor.values for sensor in every], axis=1) if every else np.zeros((count, 0))
        )
        self._whitening = Whitening(self.system, every)
        self._arguments = arguments
        self._kinematics = motion.kinematics()
        self._measured_all = True
        if errors is not None:
            values = [sensor.values for sensor in self.sensors]
            external, complete = measured_wrenches(tree, self._kinematics, self.sensors, values)
            self._measured_all = complete and not self.system.contacts
            self._linearise(external, newton_euler(tree, self._kinematics, external)[0])

    def _linearise(self, external: FloatArray, joint: FloatArray) -> None:
        self._kinematics = replace(self._kinematics, external_wrench=external, joint_wrench=joint)

    def relinearised(self, x: FloatArray) -> HumanDynamics | None:
        """The same problem with errors of poses linearised at the wrenches in the unknowns `x` (n, size); None when that is not needed.

        It is where some wrenches are not measured: the first estimate then stands on those that Newton and Euler's recursion leaves out.
        """
        if self._measured_all:
            return None
        out, columns, k, count = copy(self), self.system.columns, self._kinematics, x.shape[0]
        assert k.external_wrench is not None
        assert k.joint_wrench is not None
        good = np.asarray(np.isfinite(x).all(axis=1)).reshape(-1, 1, 1)
        external = x[:, columns.external_wrench.ravel()].reshape(count, -1, 6)
        joint = x[:, columns.joint_wrench.ravel()].reshape(count, -1, 6)
        out._linearise(np.where(good, external, k.external_wrench), np.where(good, joint, k.joint_wrench))
        out._measured_all = True
        return out

    # ---- many frames: the protocol FrameProblem ---------------------------------------------------------------

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.motion)

    def __len__(self) -> int:
        return len(self.motion)

    @property
    def noise(self) -> HumanDynamicsNoise:
        """Variances of the model, the pseudo-measurements and the prior."""
        return self.system.noise

    @property
    def pattern(self) -> LeastSquares:
        """A least-squares problem with the pattern of every frame."""
        return self.system.pattern

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        """Groups of unknowns whose joint covariance the view needs."""
        return self.system.marginals

    def whitened_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Whitened non-zeros (n, nnz) and right-hand sides (n, rows) of some frames."""
        values = self._values[frames]
        entries, rhs = self.system.raw(self._kinematics.select(frames), values)
        self._whitening.apply(entries, rhs, values, frames)
        return entries, rhs

    def inequality_frames(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Non-zeros (n, nnz) of the inequalities' rows and their limits (n, rows) of some frames."""
        k, rows = self._kinematics.select(frames), self.pattern.inequalities
        entries, limits = np.empty((k.count, rows.matrix.nnz)), np.empty((k.count, rows.height))
        for constraint in self.constraints:
            blocks, limit = constraint.all_rows(self.system.tree, k)
            limits[:, rows.slices[constraint.name]] = limit
            patterns = rows.patterns_of(constraint.name)
            for variable, block in blocks.items():
                entries[:, rows.places(constraint.name, variable)] = block[:, patterns[variable]]
        return entries, limits

    def frame(self, index: int) -> LeastSquares:
        """One frame with its values, covariances and constraints filled in; later calls refill the same object."""
        if not 0 <= index < len(self):
            raise InputError("frame", f"0 to {len(self) - 1}", str(index))
        frames, system, problem = slice(index, index + 1), self.system, self.system.pattern
        k = self._kinematics.select(frames)
        values = self._values[frames]
        entries, rhs = system.raw(k, values)
        problem.jacobian.matrix.data[:], problem.jacobian.rhs[:] = entries[0], rhs[0]
        for i, rows in enumerate(system.sensors):
            problem.set_covariance(
                rows.name, self._whitening.covariance(i, index, values[0, system.value_slices[i]])
            )
        if system.hard_dynamics:
            hard, right = system.hard(k)
            problem.equalities.matrix.data[:], problem.equalities.rhs[:] = hard[0], right[0]
        for constraint in self.constraints:
            blocks, limit = constraint.rows(self.system.tree, k)
            problem.set_constraint(constraint.name, blocks, limit)
        return problem

    @property
    def kinematics(self) -> LinkKinematics:
        """Of all frames, with the wrenches at which errors of poses are linearised."""
        return self._kinematics

    def view_frames(self, result: Any) -> HumanDynamicsEstimate:
        """The typed view of all frames (a :class:`factorgrasp.solvers.frames.FrameResult`)."""
        return read_frames(self, result)

    # ---- one frame: the protocol LinearProblem ----------------------------------------------------------------

    def at(self, frames: int | slice | BoolArray | IntArray) -> HumanDynamics:
        """The same problem at some of the frames."""
        index = np.atleast_1d(np.arange(len(self))[frames])
        noise, contacts, hard, use = self._arguments
        sensors = tuple(sensor.frames(index) for sensor in self.sensors)
        constraints = tuple(constraint.frames(index) for constraint in self.constraints)
        out = HumanDynamics(self.motion.select(index), sensors, noise, contacts, constraints, hard, use)
        k = self._kinematics
        if k.external_wrench is not None and k.joint_wrench is not None:
            out._linearise(k.external_wrench[index], k.joint_wrench[index])
            out._measured_all = self._measured_all
        return out

    def least_squares(self) -> LeastSquares:
        """The problem of a single frame, for :func:`factorgrasp.solve` with any solver."""
        if len(self) != 1:
            raise InputError(
                "human dynamics",
                "one frame here",
                f"{len(self)}",
                "Use solve_frames(problem), or solve(problem.at(k))",
            )
        return self.frame(0)

    def view(self, estimate: Estimate) -> HumanDynamicsEstimate:
        """The typed view of a single frame."""
        return self.view_frames(_as_result(self, estimate))


def _as_result(problem: HumanDynamics, estimate: Estimate) -> Any:
    """A single estimate in the form of a result of frames."""
    from types import SimpleNamespace

    system = problem.pattern
    x = np.concatenate([estimate.values[v.name] for v in system.variables])[None]
    covariance = estimate.covariance_source is not None
    blocks: list[FloatArray] = []
    variances = np.empty((1, 0))
    if covariance:
        eye = np.eye(system.size)
        P = estimate.readout_covariance(eye)
        variances = np.diag(P)[None].copy()
        blocks = [P[np.ix_(group, group)][None] for group in problem.marginals]
    return SimpleNamespace(
        x=x, variances=variances, marginals=tuple(blocks), status=(estimate.status,),
        messages={0: estimate.message} if estimate.message else {}, solver=estimate.solver,
        time=estimate.timing.get("total", float("nan")), careful=0, multipliers=(dict(estimate.multipliers),),
    )  # fmt: skip
