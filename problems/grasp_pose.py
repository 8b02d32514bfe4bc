"""Grasp pose: rotation and lever arm between a robot's end-effector and the human hand on the same object.

Model and estimator: mathematics 2.1 and 2.3 (after Cehajic 2015, in corrected form). Two IMU-level relations,
linear in products of the measured signals, compressed to second moments per frequency band; see
:mod:`factorgrasp.problems.grasp_model` and ``grasp_windows``.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgrasp import rotation_relaxation
from factorgrasp.errors import InputError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares
from factorgrasp.losses import make_loss
from factorgrasp.observability import default_words
from factorgrasp.problems import grasp_words
from factorgrasp.problems.grasp_estimate import GraspDiagnostics, GraspPoseEstimate
from factorgrasp.problems.grasp_global import better_rotation, rotation_cost
from factorgrasp.problems.grasp_kinematics import RobotKinematics, RobotStream, gap_limit, robot_kinematics
from factorgrasp.problems.grasp_model import GraspModel, phi_information, quadratic_forms
from factorgrasp.problems.grasp_model_check import ModelCheck, check_model
from factorgrasp.problems.grasp_noise import (
    BandVariances,
    NoiseMoments,
    declared_variances,
    estimated_variances,
    noise_moments,
)
from factorgrasp.problems.grasp_recording import (
    SMALLEST_CORRELATION,
    CoupledWindows,
    CouplingGrid,
    HandSignals,
    coupling_grid,
    find_clock,
    tilt_axes,
    used_samples,
)
from factorgrasp.problems.grasp_settings import GraspNoise, GraspPrior, GraspSettings
from factorgrasp.problems.grasp_system import (
    SENSOR_ERRORS,
    floored_inverse,
    grasp_variables,
    insignificant,
    least_squares_pattern,
    positive_part,
    prior_precision,
    prior_residual,
    wahba_start,
)
from factorgrasp.problems.grasp_windows import Moments, compress, stretches
from factorgrasp.recordings import ImuStream
from factorgrasp.typing import FloatArray, State

# Stretches whose scores are compared by the model check: enough for a test, long enough to see slow drifts.
STRETCHES = 12
# The model is linear in the remaining offset; at this size the neglected second order is below 1e-4 of any
# signal up to 20 Hz.
SETTLED_OFFSET = 1e-4
# Weights that change by less than this are settled, and so are estimates that new weights move by less than
# this many standard deviations.
SETTLED_WEIGHTS = 0.02
SETTLED_STEP = 0.02
SETTLED_ROBUST_STEP = 0.1
# Where fewer windows than this are free of gaps, shorter ones are tried, down to this length (s).
ENOUGH_COVERED = 0.5
SHORTEST_WINDOW = 0.1


@dataclass(frozen=True)
class GraspWeights:
    """What re-weighting settled: band variances, window weights and the time offset already applied to the hand's stamps."""

    variances: BandVariances
    windows: FloatArray | None
    time_offset: float


class GraspPose:
    """The grasp-pose problem for one recording.

    Parameters
    ----------
    robot : PoseStream, MotionStream, ImuStream or JointStream
        End-effector motion on the robot's clock.
    hand : ImuStream
        Angular velocity (rad/s) and specific force (m/s^2) of the IMU on the hand, on its own clock.
    noise : GraspNoise
    settings : GraspSettings
    gravity : (3,) array_like
        In the robot's world frame, m/s^2.
    prior : GraspPrior
    robot_model : pinocchio.Model, optional
        With `frame`, for joint positions.
    frame : str, optional
        Name of the end-effector's frame in `robot_model`.

    Raises
    ------
    InputError
        Naming the field, for recordings that do not overlap, are too short, or look like other units than
        declared.
    """

    kind = "grasp_pose"

    def __init__(
        self,
        robot: RobotStream,
        hand: ImuStream,
        noise: GraspNoise | None = None,
        settings: GraspSettings | None = None,
        gravity: Sequence[float] | FloatArray = (0.0, 0.0, -9.80665),
        prior: GraspPrior | None = None,
        robot_model: Any = None,
        frame: str | None = None,
    ) -> None:
        self.noise, self.settings = noise or GraspNoise(), settings or GraspSettings()
        self.prior = prior or GraspPrior()
        self.gravity = checked_gravity(gravity)
        if not isinstance(hand, ImuStream):
            raise InputError(
                "hand",
                "an ImuStream (angular velocity and specific force)",
                type(hand).__name__,
                "For a second sensor that gives poses, use GraspPoseFromPoses",
            )
        self._streams = (robot, hand)
        bandwidth = self.settings.bandwidth or min(20.0, 0.2 * min(robot.rate, hand.rate))
        self.bandwidth = bandwidth
        motion = robot_kinematics(
            robot,
            self.noise,
            self.gravity,
            self.settings.kinematics_bandwidth or 2.0 * bandwidth,
            self.settings.max_gap,
            robot_model,
            frame,
        )
        self.kinematics_bandwidth = motion.bandwidth
        self._hand = HandSignals.from_stream(hand, self.settings.max_gap)
        self.clock = find_clock(motion, self._hand, self.settings, bandwidth)
        tilt = tilt_axes(self.gravity) if self.settings.base_tilt else None
        self._grid, self._windows = self._window(motion, hand.rate, tilt)
        # Where the two sides do not turn together, clocks and sensor errors would only chase noise.
        hopeless = (
            frozenset((*SENSOR_ERRORS, "time_offset"))
            if self.clock.correlation < SMALLEST_CORRELATION
            else frozenset()
        )
        self.model = GraspModel(*grasp_variables(self.noise, self.settings, hopeless))
        self._expected: NoiseMoments = noise_moments(
            motion.noise(self._grid.windowing.frequencies),
            self.noise,
            self._grid.windowing,
            self._grid.mean_force,
            self._grid.rate_moment,
            self.model.accelerometer_width,
        )
        self.declared = declared_variances(
            self._expected, np.full(3, np.linalg.norm(self.prior.translation) or 0.5) / np.sqrt(3.0)
        )
        self._weights = GraspWeights(self.declared, self._forgetting(), self.clock.offset)
        self._moments = self._compress()
        self._pattern: LeastSquares | None = None
        self._start: State | None = None
        self._trust: FloatArray | None = None
        self._pruned = False
        self._checked: ModelCheck | None = None
        self._cached: tuple[tuple[Moments, GraspWeights], FloatArray, FloatArray] | None = None

    # ---- the protocol of a nonlinear problem
    # -----------------------------------------------------------------

    def initial_state(self) -> State:
        """Rotation by Wahba's closed form, the cheaper of rates alone and rates with forces; the rest at its prior mean."""
        if self._start is not None:
            return self._start
        w_g, w_a = self._weights.variances.weights
        turn = np.tensordot(w_g, self._moments.gyro.sum(axis=0), 1)[0:3, 3:6]
        pull = np.tensordot(w_a, self._moments.accelerometer.sum(axis=0), 1)[0:3, 12:15]
        # Rates alone leave the angle about a constant axis to chance; forces alone misread a long lever arm.
        starts = np.stack([wahba_start(turn, self.prior), wahba_start(turn + pull, self.prior)])
        state = {**self._blank_state(), "rotation": starts[0]}
        costs = rotation_relaxation.rotation_cost(self._rotation_cost(state), starts)
        return {**state, "rotation": starts[int(np.argmin(costs))]}

    def linearize(self, state: State) -> LeastSquares:
        """Compressed rows: ``e = L(x) S`` with ``S S'`` the weighted, noise-corrected moments, and one row a prior component."""
        if self._pattern is None:
            self._pattern = least_squares_pattern(
                self.model, prior_precision(self.model, self.noise, self.prior)
            )
        L_g, L_a = self.model.matrices(state)
        J_g, J_a = self.model.jacobians(state)
        root_g, root_a = self._roots()
        for name, L, J, root in (("gyroscope", L_g, J_g, root_g), ("accelerometer", L_a, J_a, root_a)):
            term = self._pattern.terms[name]
            rows = J @ root
            blocks = {v: rows[self.model.columns[v]].reshape(-1, term.rows).T for v in term.variables}
            self._pattern.set_term(name, blocks, -(L @ root).ravel())
        for variable in self.model.variables:
            jacobian, value = prior_residual(variable, state, self.prior)
            self._pattern.set_term(f"prior of {variable.name}", {variable.name: jacobian}, -value)
        return self._pattern

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return {
            v.name: v.retract(state[v.name], step[self.model.columns[v.name]]) for v in self.model.variables
        }

    def refine(self, state: State) -> GraspPose | None:
        """The problem with clocks shifted by the offset found and bands re-weighted by their residual power; None when settled."""
        shift = float(state["time_offset"][0]) if "time_offset" in state else 0.0
        moved = abs(shift) > SETTLED_OFFSET
        settled = SETTLED_STEP if self.settings.loss == "none" else SETTLED_ROBUST_STEP
        if not moved and self._start is not None and self._moved(self._start, state) < settled:
            return self._without_sensor_errors(state)
        out = copy.copy(self)
        if moved:
            offset = self._weights.time_offset + shift
            out._windows = self._couple(offset)
            out._weights = GraspWeights(self._weights.variances, self._weights.windows, offset)
            out._weights = GraspWeights(self._weights.variances, out._forgetting(), offset)
            out._moments = out._compress()
            state = {**state, "time_offset": np.zeros(1)}
        robust = make_loss(self.settings.loss, self.settings.loss_scale)
        variances = estimated_variances(
            self.model,
            state,
            out._moments,
            self.declared,
            floored_inverse(self._information(state)),
            self._weights.variances,
            self.settings.adapt_noise,
        )
        windows = out._forgetting()
        if robust is not None:
            trust = robust.weight(out._window_norms(state, variances))
            if self._trust is not None and self._trust.size == trust.size:
                # Redescending losses otherwise hop between two sets of windows.
                trust = np.sqrt(trust * self._trust)
            out._trust = trust
            windows = trust if windows is None else windows * trust
        changed = variances.change_from(self._weights.variances) > SETTLED_WEIGHTS
        if robust is not None:
            before = 1.0 if self._weights.windows is None or moved else self._weights.windows
            changed |= bool(
                np.max(np.abs((windows if windows is not None else 1.0) - before)) > SETTLED_WEIGHTS
            )
        if not (moved or changed):
            return self._without_sensor_errors(state)
        out._weights = GraspWeights(variances, windows, out._weights.time_offset)
        if robust is not None:
            out._moments = out._compress()
        out._start = dict(state)
        return out

    def escape(self, state: State) -> State | None:
        """A start in the basin of a better rotation, or None when this one is the global optimum or nothing better is found."""
        rotation = better_rotation(self._rotation_cost(state), state["rotation"])
        return None if rotation is None else {**self._blank_state(), "rotation": rotation}

    def score_covariance(self, state: State) -> FloatArray:
        """Covariance (n, n) of the gradient: sandwich meat of noise-corrected, forgetting and robust weights, and of model error.

        With the uncorrected, squared-weight moments it is what the noise model says. Where stretches of the
        recording or bands of frequency disagree significantly more, the affected unknowns are widened to that
        disagreement.
        """
        if self.clock.correlation < SMALLEST_CORRELATION:
            # Robot and hand are not seen to turn together: noise alone shaped this state, and nothing of the
            # grasp is known.
            H = self._information(state)
            known = np.linalg.inv(np.diag(prior_precision(self.model, self.noise, self.prior)))
            return np.asarray(H @ known @ H)
        meat = self._model_meat(state)
        if not self.settings.check_model:
            return meat
        self._checked = self.check(state)
        return self._checked.widened(self._information(state), meat)

    def check(self, state: State) -> ModelCheck:
        """Test whether stretches, frequency bands and both sides tell the same story."""
        return check_model(
            self.model,
            state,
            self._moments,
            self._expected,
            self._weights.variances,
            prior_precision(self.model, self.noise, self.prior),
            self._information(state),
            self._model_meat(state),
            self._grid.windowing.frequencies,
            self.settings.errors_in_variables,
        )

    def describe_direction(self, variable: Any, vector: FloatArray) -> str:
        """Words for a direction of an unknown."""
        if variable.name not in ("rotation", "translation"):
            return default_words(variable, vector)
        return grasp_words.direction(variable.name, vector, self._grid.rate_moment)

    @property
    def advice(self) -> str:
        """What would inform the directions that are missing."""
        return grasp_words.advice(self._grid.rate_moment, self._checked)

    def view(self, estimate: Estimate) -> GraspPoseEstimate:
        """The typed view, with the whole time offset and the data that reports draw."""
        return GraspPoseEstimate.from_estimate(estimate, self)

    # ---- what other parts of the library read
    # ----------------------------------------------------------------

    @property
    def time_offset(self) -> float:
        """Offset (s, hand minus robot) already applied to the hand's stamps."""
        return self._weights.time_offset

    @property
    def moments(self) -> Moments:
        """Second moments per stretch and band."""
        return self._moments

    @property
    def variances(self) -> BandVariances:
        """Residual variance of every band in use."""
        return self._weights.variances

    @property
    def streams(self) -> tuple[RobotStream, ImuStream]:
        """The recordings."""
        return self._streams

    def corrected_moments(self) -> tuple[FloatArray, FloatArray]:
        """Weighted sums over bands of the moments, less their expected noise: (10, 10) and (m, m)."""
        w_g, w_a = self._weights.variances.weights
        gyro = np.tensordot(w_g, self._moments.gyro.sum(axis=0), 1)
        accelerometer = np.tensordot(w_a, self._moments.accelerometer.sum(axis=0), 1)
        if self.settings.errors_in_variables:
            dof = self._moments.dof.sum(axis=0)
            gyro -= np.tensordot(w_g * dof, self._expected.gyro, 1)
            accelerometer -= np.tensordot(w_a * dof, self._expected.accelerometer, 1)
        return gyro, accelerometer

    def diagnostics(self, state: State) -> GraspDiagnostics:
        """Residuals, spectra and data use at a state, for reports."""
        L_g, L_a = self.model.matrices(state)
        windows, windowing = self._windows, self._grid.windowing
        e_g, e_a = windows.gyro @ L_g.T, windows.accelerometer @ L_a.T
        power_g = np.sum(e_g**2, axis=(0, 2, 3)) / (3.0 * windows.t.size * windowing.dof)
        power_a = np.sum(e_a**2, axis=(0, 2, 3)) / (3.0 * windows.t.size * windowing.dof)
        robot, hand = self._streams
        limits = [gap_limit(stream.t, self.settings.max_gap) for stream in self._streams]
        gaps = [stream.gaps(limit) for stream, limit in zip(self._streams, limits, strict=True)]
        phi = np.tensordot(self._weights.variances.weights[1], self._moments.accelerometer.sum(axis=0), 1)[
            :12, :12
        ]
        return GraspDiagnostics(
            t=windows.t,
            gyro_residual=np.sqrt(np.sum(e_g**2, axis=(1, 2)) / windowing.dof.sum()),
            accelerometer_residual=np.sqrt(np.sum(e_a**2, axis=(1, 2)) / windowing.dof.sum()),
            window_weight=np.ones(windows.t.size) if self._weights.windows is None else self._weights.windows,
            frequencies=windowing.frequencies,
            gyro_density=np.sqrt(power_g * windowing.step),
            accelerometer_density=np.sqrt(power_a * windowing.step),
            declared_gyro_density=np.sqrt(self.declared.gyro * windowing.step),
            declared_accelerometer_density=np.sqrt(self.declared.accelerometer * windowing.step),
            windows_used=int(windows.t.size),
            windows_dropped=windows.dropped,
            window_seconds=windowing.length * windowing.step,
            samples_used=float(np.mean(used_samples(self._grid, windows))),
            robot_gaps=(gaps[0].count, gaps[0].seconds, int(np.count_nonzero(~robot.valid))),
            hand_gaps=(gaps[1].count, gaps[1].seconds, int(np.count_nonzero(~hand.valid))),
            excitation=np.asarray(np.linalg.eigvalsh(phi_information(phi)), dtype=float),
            rate_moment=self._grid.rate_moment,
            clock_correlation=self.clock.correlation,
            clock_ambiguity=self.clock.ambiguity,
            bandwidth=self.bandwidth,
            kinematics_bandwidth=self.kinematics_bandwidth,
            slow_force_residual=float(np.sqrt(np.sum(power_a[:2] * windowing.dof[:2]) / windowing.dof.sum())),
        )

    # ---- internals
    # -------------------------------------------------------------------------------------------

    def _without_sensor_errors(self, state: State) -> GraspPose | None:
        """The same problem less those sensor errors that turned out to be nothing; None when there are none to drop."""
        if self.settings.sensor_errors != "auto" or self._pruned:
            return None
        bread = floored_inverse(self._information(state))
        drop = insignificant(self.model.variables, state, bread @ self._model_meat(state) @ bread)
        if not drop:
            return None
        out = copy.copy(self)
        out.model = GraspModel(*grasp_variables(self.noise, self.settings, drop | set(self.model.fixed)))
        out._pruned, out._pattern = True, None
        out._start = {variable.name: state[variable.name] for variable in out.model.variables}
        return out

    def _moved(self, before: State, after: State) -> float:
        """Largest change of an unknown in standard deviations."""
        sd = np.sqrt(np.diag(floored_inverse(self._information(after))))
        steps = [
            v.local(before[v.name], after[v.name]) / sd[self.model.columns[v.name]]
            for v in self.model.variables
        ]
        return float(np.max(np.abs(np.concatenate(steps))))

    def _rotation_cost(self, state: State) -> FloatArray:
        root_g, root_a = self._roots()
        return rotation_cost(
            self.model,
            state,
            root_g @ root_g.T,
            root_a @ root_a.T,
            prior_precision(self.model, self.noise, self.prior),
            self.prior,
        )

    def _blank_state(self) -> dict[str, FloatArray]:
        state = {variable.name: np.zeros(variable.size) for variable in self.model.variables}
        state["translation"] = self.prior.translation.copy()
        return state

    def _window(
        self, motion: RobotKinematics, hand_rate: float, tilt: FloatArray | None
    ) -> tuple[CouplingGrid, CoupledWindows]:
        """Windows of the wanted length, or shorter ones where gaps are so dense that they touch most of them."""
        seconds, best = self.settings.window, -1.0
        while best < ENOUGH_COVERED and (best < 0.0 or seconds >= SHORTEST_WINDOW):
            grid = coupling_grid(motion, hand_rate, self.bandwidth, seconds, tilt)
            windows = grid.couple(self._hand, self.clock.offset)
            covered = windows.t.size / max(windows.t.size + windows.dropped, 1)
            if covered > best:
                best, chosen = covered, (grid, windows)
            seconds *= 0.5
        return chosen[0], self._enough(*chosen, self.clock.offset)

    def _couple(self, offset: float) -> CoupledWindows:
        return self._enough(self._grid, self._grid.couple(self._hand, offset), offset)

    def _enough(self, grid: CouplingGrid, windows: CoupledWindows, offset: float) -> CoupledWindows:
        if windows.t.size < 2:
            robot, hand = self._streams
            seconds = grid.windowing.length * grid.windowing.step
            raise InputError(
                "robot and hand",
                f"at least two common windows of {seconds:.3g} s without gaps",
                f"{windows.t.size} (robot {robot.t[0]:.6g} to {robot.t[-1]:.6g} s, hand {hand.t[0]:.6g} to "
                f"{hand.t[-1]:.6g} s, offset {offset:.4g} s, {windows.dropped} windows with gaps)",
                "Record longer, or with fewer gaps",
            )
        return windows

    def _forgetting(self) -> FloatArray | None:
        if self.settings.forgetting_time is None:
            return None
        t = self._windows.t
        return np.asarray(np.exp((t - t[-1]) / self.settings.forgetting_time))

    def _compress(self) -> Moments:
        stretch = stretches(self._windows.t.size, STRETCHES)
        return compress(
            self._grid.windowing,
            self._windows.gyro,
            self._windows.accelerometer,
            stretch,
            self._weights.windows,
        )

    def _window_norms(self, state: State, variances: BandVariances) -> FloatArray:
        """Root mean square of the whitened residual of every window (about 1 where the model fits), (windows,)."""
        L_g, L_a = self.model.matrices(state)
        out = np.zeros(self._windows.t.size)
        for L, z, variance in (
            (L_g, self._windows.gyro, variances.gyro),
            (L_a, self._windows.accelerometer, variances.accelerometer),
        ):
            power = np.sum((z @ L.T) ** 2, axis=(2, 3)) / variance
            # Outliers have inflated the estimated variances; the median window sets the scale.
            total = power.sum(axis=1)
            out += total / max(float(np.median(total)), 1e-300)
        return np.asarray(np.sqrt(0.5 * out))

    def _roots(self) -> tuple[FloatArray, FloatArray]:
        """Roots (m, rank) of the positive parts of both corrected moments; they change only with moments and weights."""
        key = (self._moments, self._weights)
        if self._cached is None or any(a is not b for a, b in zip(self._cached[0], key, strict=True)):
            Z_g, Z_a = self.corrected_moments()
            self._cached = (key, positive_part(Z_g), positive_part(Z_a))
        return self._cached[1:]

    def _information(self, state: State) -> FloatArray:
        L_g, L_a = self.model.matrices(state)
        J_g, J_a = self.model.jacobians(state)
        root_g, root_a = self._roots()
        H = quadratic_forms(L_g, J_g, root_g @ root_g.T)[2] + quadratic_forms(L_a, J_a, root_a @ root_a.T)[2]
        return np.asarray(H + np.diag(prior_precision(self.model, self.noise, self.prior)))

    def _model_meat(self, state: State) -> FloatArray:
        w_g, w_a = self._weights.variances.weights
        moments = self._moments
        gyro = moments.gyro if moments.gyro_squared is None else moments.gyro_squared
        accelerometer = (
            moments.accelerometer if moments.accelerometer_squared is None else moments.accelerometer_squared
        )
        L_g, L_a = self.model.matrices(state)
        J_g, J_a = self.model.jacobians(state)
        meat = quadratic_forms(L_g, J_g, np.tensordot(w_g, gyro.sum(axis=0), 1))[2]
        meat = meat + quadratic_forms(L_a, J_a, np.tensordot(w_a, accelerometer.sum(axis=0), 1))[2]
        return np.asarray(meat + np.diag(prior_precision(self.model, self.noise, self.prior)))


def checked_gravity(gravity: Sequence[float] | FloatArray) -> FloatArray:
    out = np.asarray(gravity, dtype=float)
    if out.shape != (3,) or not np.all(np.isfinite(out)):
        raise InputError("gravity", "3 finite numbers in m/s^2", str(gravity))
    size = float(np.linalg.norm(out))
    if not 1.0 < size < 30.0:
        raise InputError(
            "gravity",
            "a vector of about 9.81 m/s^2 in the robot's world frame",
            f"{out.tolist()} (norm {size:.3g})",
        )
    return out


__all__ = ["GraspPose", "GraspWeights"]
