"""Human dynamics frame by frame: everything that does not change is worked out once, a step fills in values and solves.

Memory does not grow, and a step does no work that depends on how many came before. Without constraints a step is one
factorisation; its time varies
by the number of refinements alone.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_state import MotionAcceleration, state_sensors, torque_turn
from factorgrasp.problems.human_dynamics_system import HumanDynamicsSystem
from factorgrasp.problems.human_dynamics_whitening import Whitening
from factorgrasp.problems.link_motion import LinkKinematics, StateNoise
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree, neutral
from factorgrasp.solvers.frames import FrameResult, FrameSolver
from factorgrasp.status import Status
from factorgrasp.typing import FloatArray

Values = Mapping[str, ArrayLike] | FloatArray


@dataclass(frozen=True)
class HumanDynamicsFrame:
    """Estimate of one frame.

    Attributes
    ----------
    t : float
        s.
    torque, torque_sd : ndarray
        (dofs,) Nm; sd empty when no covariance was asked for.
    external_wrench : ndarray
        (L, 6) in the links' frames, N and Nm.
    external_wrench_covariance : ndarray
        (L, 6, 6); empty without covariance.
    joint_wrench : ndarray
        (J, 6) parent on child in the child's frame, N and Nm.
    status : Status
    message : str
    latency : float
        Seconds that the step took.
    """

    t: float
    torque: FloatArray
    torque_sd: FloatArray
    external_wrench: FloatArray
    external_wrench_covariance: FloatArray
    joint_wrench: FloatArray
    status: Status
    message: str
    latency: float


class OnlineHumanDynamics:
    """Streaming form of :class:`factorgrasp.problems.human_dynamics.HumanDynamics`, without constraints.

    Parameters
    ----------
    tree : PinocchioTree
        The body.
    sensors : sequence of Sensor
        As templates: kind, place and covariance count, their single row of values does not.
    noise : HumanDynamicsNoise
    contacts : sequence of str
    use_motion : bool
        As for the problem.
    covariance : bool
        Also compute sd of torques and covariances of external wrenches.
    state_noise : StateNoise, optional
        Of the configurations, as for a motion; it does not change over frames. Errors of poses are linearised at the
        wrenches of the last frame.
    """

    def __init__(
        self,
        tree: PinocchioTree,
        sensors: Sequence[Sensor],
        noise: HumanDynamicsNoise | None = None,
        contacts: Sequence[str] = (),
        use_motion: bool = True,
        covariance: bool = True,
        state_noise: StateNoise | None = None,
    ) -> None:
        self.tree, self.covariance = tree, covariance
        one = []
        for sensor in sensors:
            C = sensor.variances()
            if C.ndim == 3 or (C.ndim == 2 and C.shape != (sensor.size, sensor.size)):
                raise InputError(
                    f"covariance of {sensor.name}", "one that does not change over frames", "one a frame"
                )
            one.append(replace(sensor, values=sensor.values[:1]))
        self.sensors = tuple(one)
        body, every = tree.tree, self.sensors
        self._acceleration: MotionAcceleration | None = None
        if state_noise is not None:
            state_noise.check(6 * tree.floating + sum(map(len, body.dofs)), 1)
            still = tree.kinematics(neutral(tree.model), np.zeros(tree.model.nv), np.zeros(tree.model.nv))
            inner = state_sensors(body, state_noise, still, self.sensors, use_motion)
            every, use_motion = (*every, *inner), use_motion and state_noise.acceleration_gain == 0.0
            self._acceleration = next((s for s in inner if isinstance(s, MotionAcceleration)), None)
        self._own = sum(s.size for s in every[len(self.sensors) :])
        self._point: tuple[FloatArray, FloatArray] | None = None
        self.system = HumanDynamicsSystem(
            body, every, noise, contacts, use_motion, state_errors=state_noise is not None
        )
        self._whitening = Whitening(self.system, every)
        wanted = (
            [*self.system.columns.joint_wrench, *self.system.columns.external_wrench] if covariance else []
        )
        self._turning = self.system.turning
        wanted += list(self._turning.values()) if covariance else []
        self._solver = FrameSolver(self.system.pattern, wanted)
        self._places = {
            sensor.name: where for sensor, where in zip(self.sensors, self.system.value_slices, strict=False)
        }
        self._owner = np.concatenate(
            [np.full(len(tree.tree.dofs[j]), j) for j in self.system.axes] or [np.empty(0)]
        ).astype(np.intp)
        self.frames = 0
        self.worst_latency = 0.0

    def step(
        self, t: float, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, values: Values
    ) -> HumanDynamicsFrame:
        """Estimate of one frame.

        Parameters
        ----------
        t : float
            s.
        q, qd, qdd : array_like
            In pinocchio's order.
        values : mapping of str to (k,) array_like, or (m,) ndarray
            Measurements by the sensor's name, or of all sensors one after another; a sensor that is not named, or NaN, has no
            rows in this frame.

        Raises
        ------
        InputError
            For a name that no sensor has, or a value of another size.
        """
        started = time.perf_counter()
        return self._finish(t, self.tree.kinematics(q, qd, qdd), values, started)

    def step_links(self, t: float, kinematics: LinkKinematics, values: Values) -> HumanDynamicsFrame:
        """The same from kinematics of one frame, such as ``LinkMotion.kinematics(slice(k, k + 1))``."""
        if kinematics.count != 1:
            raise InputError("kinematics", "one frame", str(kinematics.count))
        return self._finish(t, kinematics, values, time.perf_counter())

    def _finish(self, t: float, k: LinkKinematics, values: Values, started: float) -> HumanDynamicsFrame:
        rows = self._rows(values)
        if not self.system.state_errors:
            return self._read(t, k, self._solve(k, rows), started)
        own = [np.zeros((1, self._own))]
        if self._acceleration is not None:
            measured = self._acceleration.read(self.system.tree, k)
            own = [np.zeros((1, self._own - measured.shape[1])), measured]
        rows = np.concatenate([rows, *own], axis=1)
        if self._point is None:
            self._keep(self._solve(k, rows))
        if self._point is not None:
            k = replace(k, external_wrench=self._point[0], joint_wrench=self._point[1])
        result = self._solve(k, rows)
        self._keep(result)
        return self._read(t, k, result, started)

    def _solve(self, k: LinkKinematics, rows: FloatArray) -> FrameResult:
        entries, rhs = self.system.raw(k, rows)
        self._whitening.apply(entries, rhs, rows, slice(0, 1))
        return self._solver.solve(entries, rhs, self.covariance)

    def _keep(self, result: FrameResult) -> None:
        """Wrenches at which the next frame is linearised."""
        columns = self.system.columns
        if result.status[0].ok:
            self._point = result.x[:, columns.external_wrench], result.x[:, columns.joint_wrench]

    def _rows(self, values: Values) -> FloatArray:
        size = self.system.value_slices[len(self.sensors) - 1].stop if self.sensors else 0
        if isinstance(values, np.ndarray):
            if values.shape != (size,):
                raise InputError(
                    "values", f"shape ({size},) for all sensors one after another", str(values.shape)
                )
            return np.asarray(values, dtype=float)[None]
        out = np.full((1, size), np.nan)
        row = out[0]
        for name, value in values.items():
            where = self._places.get(name)
            if where is None:
                raise InputError("values", "names among " + ", ".join(sorted(self._places)), repr(name))
            if np.shape(value) != (where.stop - where.start,):
                raise InputError(name, f"shape ({where.stop - where.start},)", str(np.shape(value)))
            row[where] = value
        return out

    def _read(self, t: float, k: LinkKinematics, result: FrameResult, started: float) -> HumanDynamicsFrame:
        columns, x, S = self.system.columns, result.x[0], k.axes[0]
        wrench = x[columns.joint_wrench]
        torque = np.einsum("di,di->d", S, wrench[self._owner])
        turns = {j: torque_turn(S[self._owner == j].T[None], wrench[j][None])[0] for j in self._turning}
        for j, T in turns.items():
            torque[self._owner == j] += T @ x[self._turning[j][6:]]
        sd, cov = np.empty(0), np.empty((0, 6, 6))
        if self.covariance:
            joints = wrench.shape[0]
            links = len(self.system.tree.links)
            P = np.stack(result.marginals[: joints + links])[:, 0]
            variance = np.einsum("di,dij,dj->d", S, P[self._owner], S)
            cov = P[joints:]
            for j, block in zip(self._turning, result.marginals[joints + links :], strict=True):
                own = np.flatnonzero(self._owner == j)
                reader = np.concatenate([S[own], turns[j]], axis=1)
                variance[own] = np.einsum("di,ij,dj->d", reader, block[0], reader)
            sd = np.sqrt(np.maximum(variance, 0.0))
        self.frames += 1
        latency = time.perf_counter() - started
        self.worst_latency = max(self.worst_latency, latency)
        return HumanDynamicsFrame(
            float(t),
            torque,
            sd,
            x[columns.external_wrench],
            cov,
            wrench,
            result.status[0],
            result.messages.get(0, ""),
            latency,
        )
