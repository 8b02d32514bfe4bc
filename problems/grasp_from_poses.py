"""Grasp pose when the second, rigidly coupled sensor gives poses in its own world: a camera that tracks a target, say.

Rotation and position of the rigid coupling (``R_w_r R_r_h = R_w_t R_t_h``, ``R_w_r p_r_h + p_w_r = R_w_t p_t_h + p_w_t``) are compared at
every sample of the slower stream; unknown are the grasp, the other world and the time offset. See ``hand_eye_math`` for the residuals.
"""

from __future__ import annotations

import copy

import numpy as np

from factorgrasp import lie
from factorgrasp.errors import InputError, UnobservableError
from factorgrasp.estimate import Estimate
from factorgrasp.least_squares import LeastSquares, Term
from factorgrasp.problems.cluster_scores import (
    cluster_score_covariance,
    drowned_directions,
    without_noise_information,
)
from factorgrasp.problems.grasp_from_poses_estimate import GraspFromPosesDiagnostics, GraspFromPosesEstimate
from factorgrasp.problems.grasp_from_poses_settings import (
    FEWEST_CLUSTERS,
    GraspFromPosesNoise,
    GraspFromPosesSettings,
)
from factorgrasp.problems.grasp_settings import GraspPrior
from factorgrasp.problems.grasp_words import axis_words
from factorgrasp.problems.hand_eye_math import COLUMNS, PoseCoupling, coupling_rows, noise_information
from factorgrasp.problems.hand_eye_start import ClockMatch, match_clocks, start_state
from factorgrasp.problems.held_directions import HELD_TERM, HeldDirections, fill_held, held_term
from factorgrasp.recordings import PoseStream
from factorgrasp.typing import FloatArray, IntArray, State
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable, retract, slices

# Below this the two sides do not move alike at any offset, and the clocks are left as they are.
SMALLEST_CORRELATION = 0.5
# Median of chi2 with three degrees of freedom.
_MEDIAN_CHI2_3 = 2.366
_SETTLED_NOISE = 0.02
_FEWEST_SAMPLES = 20
# 1 - |mean rotation| along an axis: 1e-4 is a rotation of about 1 deg rms.
_HARDLY_ROTATES = 1e-4
_ONE_AXIS = 0.02


class GraspPoseFromPoses:
    """The grasp-pose problem for two pose streams.

    Parameters
    ----------
    robot : PoseStream
        ``(R_w_r, p_w_r)`` of the end-effector in the robot's world, robot clock.
    hand : PoseStream
        ``(R_t_h, p_t_h)`` of the second sensor in its own world, on its own clock: ``t_hand = t_robot + time offset``.
    noise : GraspFromPosesNoise
    settings : GraspFromPosesSettings
    prior : GraspPrior

    Raises
    ------
    InputError
        Naming the field, for streams of another kind, that do not overlap or are too short.
    UnobservableError
        When the robot does not move at all.
    """

    kind = "grasp_pose_from_poses"

    def __init__(
        self,
        robot: PoseStream,
        hand: PoseStream,
        noise: GraspFromPosesNoise | None = None,
        settings: GraspFromPosesSettings | None = None,
        prior: GraspPrior | None = None,
    ) -> None:
        for name, stream in (("robot", robot), ("hand", hand)):
            if not isinstance(stream, PoseStream):
                raise InputError(
                    name,
                    "a PoseStream (positions and quaternions)",
                    type(stream).__name__,
                    "For an IMU on the hand, use GraspPose",
                )
        self.noise, self.settings = noise or GraspFromPosesNoise(), settings or GraspFromPosesSettings()
        self.prior = prior or GraspPrior()
        self._streams = (robot, hand)
        self._coupling = PoseCoupling.from_streams(robot, hand, self.settings.max_gap)
        self.variables = _variables(self.settings)
        self._columns = slices(self.variables)
        self._loss = self.settings.make_loss()
        self._require_motion()
        self.clock = self._match_clocks()
        self._covariance = np.diag(np.repeat([self.noise.rotation_sd**2, self.noise.position_sd**2], 3))
        self._start: State | None = None
        self._held: HeldDirections | None = None
        self._system: LeastSquares | None = None
        self._select(self.clock.offset)

    # ---- the protocol of a nonlinear problem -----------------------------------------------------------------

    def initial_state(self) -> State:
        """Wahba on relative rotations, means and linear least squares for the rest (mathematics 2.3); a refined problem goes on."""
        if self._start is None:
            self._start = self._known(
                start_state(self._coupling, self._samples, self.clock.offset, self.prior.translation)
            )
            self._held = self._hold(self._start)
        return dict(self._start)

    def linearize(self, state: State) -> LeastSquares:
        """Six rows a sample, [rotation; position] in the hand frame, and one row a component with a prior."""
        if self._system is None:
            held = [] if self._held is None else [held_term(self._held, self.variables)]
            self._system = LeastSquares(self.variables, [*self._terms(), *held])
        # Refined problems share the system, but not the covariance.
        self._system.set_covariance("pose", Covariance.blocks(self._covariance))
        self._fill(self._system, state)
        return self._system

    def retract(self, state: State, step: FloatArray) -> State:
        """Move the state by a tangent step (n,)."""
        return self._known(retract(self.variables, state, step))

    def refine(self, state: State) -> GraspPoseFromPoses | None:
        """The same problem with noise as its residuals show and samples chosen for the time offset found; None when settled."""
        offset = float(self._known(state)["time_offset"][0])
        moved = abs(offset - self._chosen_for) > 0.5 * self._margin
        covariance = self._residual_covariance(state)
        relative = np.linalg.solve(self._covariance, covariance)
        changed = bool(np.max(np.abs(np.linalg.eigvals(relative) - 1.0)) > _SETTLED_NOISE)
        if not (moved or changed):
            return None
        fresh = copy.copy(self)
        fresh._covariance, fresh._start = covariance, dict(state)
        if moved:
            fresh._select(offset)
        return fresh

    def score_covariance(self, state: State) -> FloatArray:
        """Covariance (n, n) of the gradient: errors of real poses persist, and their noise looks like motion.

        From the scatter of the gradient over stretches of the recording, widened where most of the information is noise of the poses.
        """
        system = self.linearize(state)
        weights = system.robust_weights(system.residuals(np.zeros(system.size)))
        matrix, rhs = system.whitened(weights)
        where = system.jacobian.slices["pose"]
        # Behind the poses stand the priors and what is held.
        rows, other_rows = matrix[where].toarray(), matrix[where.stop :].toarray()
        prior = other_rows.T @ other_rows
        information = rows.T @ rows + prior
        cluster = self._clusters()
        if self.settings.clusters == 0 or np.unique(cluster).size < FEWEST_CLUSTERS:
            score = information
        else:
            score = cluster_score_covariance(rows, rhs[where], np.repeat(cluster, 6), prior)
        noise = self._noise_information(state, weights)
        if self._held is not None:
            held = matrix[system.jacobian.slices[HELD_TERM]].toarray()
            noise = noise + held.T @ held
        return without_noise_information(score, information, self._known_beforehand(), noise)

    def describe_direction(self, variable: Variable, vector: FloatArray) -> str:
        """Words for a direction of the rotation or the lever arm."""
        if variable.name == "rotation":
            return f"rotation about hand axis {axis_words(vector)}"
        words = f"lever arm along end-effector axis {axis_words(vector)}"
        spread, axes = self._rotation_spread()
        if (
            spread[2] > _HARDLY_ROTATES
            and spread[0] < _ONE_AXIS * spread[1]
            and abs(float(axes[:, 0] @ vector)) > 0.9
        ):
            return words + ", which is the rotation axis"
        return words

    @property
    def advice(self) -> str:
        """What would inform the directions that are missing."""
        spread, _ = self._rotation_spread()
        degrees = float(np.degrees(np.sqrt(max(spread.sum(), 0.0))))
        if spread[2] <= _HARDLY_ROTATES:
            return (
                f"The end-effector hardly rotates ({degrees:.2g} deg about its mean orientation): only a rotation shows the lever arm. "
                "Rotate the object by some tens of degrees about at least two axes."
            )
        if spread[0] < _ONE_AXIS * spread[1]:
            return (
                "The end-effector rotates about one axis only: a lever arm along that axis cannot be told from a shift of the other "
                "world, nor (unless the end-effector also travels) a turn about it from a turn of the other world. Add a rotation about "
                "a second axis."
            )
        return (
            f"The orientations ({degrees:.2g} deg about their mean) differ too little for the errors of the poses: rotate further, about "
            "changing axes, and record longer."
        )

    def view(self, estimate: Estimate) -> GraspFromPosesEstimate:
        """The typed view, with the residuals that reports draw."""
        state = self._known(estimate.values)
        return GraspFromPosesEstimate.from_estimate(estimate, state, self.diagnostics(state))

    # ---- what other parts of the library read ----------------------------------------------------------------

    @property
    def streams(self) -> tuple[PoseStream, PoseStream]:
        """The recordings."""
        return self._streams

    @property
    def noise_covariance(self) -> FloatArray:
        """Covariance (6, 6) of one comparison, [rotation; position] in the hand frame, as used for weighting (rad, m)."""
        return self._covariance.copy()

    def diagnostics(self, state: State) -> GraspFromPosesDiagnostics:
        """Residuals, weights and data use at a state, for reports."""
        residual, _ = self._rows(self._known(state))
        used = np.any(residual != 0.0, axis=1)
        weight = np.ones(len(residual)) if self._loss is None else self._loss.weight(self._norms(residual))
        return GraspFromPosesDiagnostics(
            t=self._coupling.sampled.t[self._samples][used],
            rotation_residual=residual[used, :3],
            position_residual=residual[used, 3:],
            weight=weight[used],
            noise_covariance=self.noise_covariance,
            sampled=self._streams[1].name if self._coupling.at_hand else self._streams[0].name,
            samples_used=int(np.count_nonzero(used)),
            samples_dropped=int(self._coupling.sampled.t.size - np.count_nonzero(used)),
            clock_correlation=self.clock.correlation,
            rotation_spread=self._rotation_spread()[0],
        )

    # ---- internals -------------------------------------------------------------------------------------------

    def _require_motion(self) -> None:
        robot = self._coupling.robot
        turn, way = robot.noise[0]
        travel = float(np.linalg.norm(robot.position.std(axis=0)))
        if self._rotation_spread()[0][2] <= 6.0 * turn**2 + 1e-9 and travel <= 3.0 * way + 1e-5:
            raise UnobservableError(
                "the robot stands still, which shows nothing of the grasp: move and rotate the object, by some tens of degrees about at "
                "least two axes"
            )

    def _match_clocks(self) -> ClockMatch:
        guess = self.settings.time_offset_guess
        # Without a search the correlation at the guess still tells whether the two sides moved together at all.
        reach = self.settings.max_time_offset if self.settings.time_offset else 0.0
        found = match_clocks(self._coupling, guess, reach)
        if not self.settings.time_offset or found.correlation < SMALLEST_CORRELATION:
            return ClockMatch(guess, found.correlation)
        return found

    def _select(self, offset: float) -> None:
        """Choose the samples that stay clear of gaps while the time offset settles near `offset`."""
        self._margin = (
            max(2.0 * self._coupling.interpolated.step, 0.02) if self.settings.time_offset else 1e-9
        )
        self._chosen_for = offset
        self._samples: IntArray = self._coupling.usable(offset, self._margin)
        self._system = None
        if self._samples.size < _FEWEST_SAMPLES:
            robot, hand = self._streams
            raise InputError(
                "robot and hand",
                f"at least {_FEWEST_SAMPLES} samples of one side that lie between samples of the other",
                f"{self._samples.size} (robot {robot.t[0]:.6g} to {robot.t[-1]:.6g} s, hand {hand.t[0]:.6g} to {hand.t[-1]:.6g} s, "
                f"offset {offset:.4g} s)",
                "Check the clocks (estimate.time_offset_guess) and estimate.max_gap",
            )

    def _known(self, state: State) -> dict[str, FloatArray]:
        """The state with the time offset even where it is given."""
        return {"time_offset": np.array([self.settings.time_offset_guess]), **state}

    def _rows(self, state: State) -> tuple[FloatArray, FloatArray]:
        state = self._known(state)
        return coupling_rows(state, self._coupling.at(self._samples, float(state["time_offset"][0])))

    def _norms(self, residual: FloatArray) -> FloatArray:
        lower = np.linalg.cholesky(self._covariance)
        return np.asarray(np.linalg.norm(np.linalg.solve(lower, residual.T), axis=0))

    def _residual_covariance(self, state: State) -> FloatArray:
        if self.settings.adapt_noise == "none":
            return self._covariance
        residual, _ = self._rows(state)
        residual = residual[np.any(residual != 0.0, axis=1)]
        unknowns = sum(variable.size for variable in self.variables)
        freedom = residual.size / (residual.size - unknowns)
        if self.settings.adapt_noise == "isotropic":
            squares = (residual.reshape(-1, 2, 3) ** 2).sum(axis=2)
            # Noise-free recordings still need a covariance: a micrometre and a microradian.
            variances = np.maximum(freedom * np.median(squares, axis=0) / _MEDIAN_CHI2_3, 1e-12)
            return np.asarray(np.diag(np.repeat(variances, 3)))
        weight = np.ones(len(residual)) if self._loss is None else self._loss.weight(self._norms(residual))
        covariance = freedom * (residual * weight[:, None]).T @ residual / weight.sum()
        return np.asarray(0.5 * (covariance + covariance.T) + 1e-12 * np.eye(6))

    def _noise_information(self, state: State, weights: FloatArray | None) -> FloatArray:
        """Information (n, n) that the noise of the poses only pretends."""
        state = self._known(state)
        count = self._samples.size
        robust = np.ones(count) if weights is None else weights[: 6 * count : 6]
        whitener = robust[:, None, None] * np.linalg.inv(np.linalg.cholesky(self._covariance))
        poses = self._coupling.at(self._samples, float(state["time_offset"][0]))
        out = noise_information(state, poses, self._coupling.robot.noise, self._coupling.hand.noise, whitener)
        columns = np.concatenate([np.arange(13)[COLUMNS[variable.name]] for variable in self.variables])
        return np.asarray(out[np.ix_(columns, columns)])

    def _known_beforehand(self) -> FloatArray:
        """Information (n, n) of the priors, and of what goes without saying: a rotation is within pi, the other world within 100 m."""
        out = np.zeros(sum(variable.size for variable in self.variables))
        for name, sd in {
            "rotation": np.pi,
            "world_rotation": np.pi,
            "world_translation": 100.0,
            **self._priors(),
        }.items():
            out[self._columns[name]] += 1.0 / sd**2
        return np.diag(out)

    def _hold(self, state: State) -> HeldDirections | None:
        """The start, to be kept along directions that only noise seems to inform: a search along them would never end."""
        system = LeastSquares(self.variables, self._terms())
        self._fill(system, state)
        weights = system.robust_weights(system.residuals(np.zeros(system.size)))
        information = system.normal_equations(weights)[0].toarray()
        noise = self._noise_information(state, weights)
        rows = drowned_directions(information, self._known_beforehand(), noise)
        return HeldDirections(dict(state), rows) if len(rows) else None

    def _clusters(self) -> IntArray:
        """Stretch of equal duration that each sample belongs to."""
        t = self._coupling.sampled.t[self._samples]
        share = (t - t[0]) / max(float(t[-1] - t[0]), 1e-300)
        return np.asarray(
            np.minimum(share * self.settings.clusters, self.settings.clusters - 1), dtype=np.intp
        )

    def _rotation_spread(self) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues (ascending) and axes of ``I - M'M``, M the mean of ``R_w_r``: information on the lever arm per sample."""
        robot = self._coupling.robot
        mean = robot.rotation.mean(axis=0)
        values, axes = np.linalg.eigh(np.eye(3) - mean.T @ mean)
        return np.maximum(values, 0.0), axes

    def _terms(self) -> list[Term]:
        names = tuple(variable.name for variable in self.variables)
        rows = 6 * self._samples.size
        terms = [
            Term("pose", rows, names, Covariance.blocks(self._covariance), self._loss, group=6, unit="rad, m")
        ]
        units = {variable.name: (variable.size, variable.unit) for variable in self.variables}
        for name, sd in self._priors().items():
            size, unit = units[name]
            terms.append(Term(f"prior of {name}", size, (name,), Covariance.scalar(sd**2), unit=unit))
        return terms

    def _fill(self, system: LeastSquares, state: State) -> None:
        residual, jacobian = self._rows(state)
        blocks = {v.name: jacobian[:, :, COLUMNS[v.name]].reshape(-1, v.size) for v in self.variables}
        system.set_term("pose", blocks, -residual.ravel())
        for name in self._priors():
            slope, error = self._prior_error(name, state)
            system.set_term(f"prior of {name}", {name: slope}, -error)
        if HELD_TERM in system.terms:
            assert self._held is not None
            fill_held(system, self._held, state)

    def _priors(self) -> dict[str, float]:
        out = {"translation": self.prior.translation_sd}
        if self.prior.rotation_sd is not None:
            out["rotation"] = self.prior.rotation_sd
        if self.settings.time_offset:
            out["time_offset"] = self.noise.time_offset_sd
        return out

    def _prior_error(self, name: str, state: State) -> tuple[FloatArray, FloatArray]:
        if name == "rotation":
            assert self.prior.rotation is not None
            error = lie.so3_log(self.prior.rotation.T @ state["rotation"])
            return lie.so3_right_jacobian_inverse(error), error
        mean = self.prior.translation if name == "translation" else self.clock.offset
        error = np.asarray(state[name] - mean)
        return np.eye(error.size), error


def _variables(settings: GraspFromPosesSettings) -> tuple[Variable, ...]:
    def components(words: str) -> tuple[str, ...]:
        return tuple(f"{words} {axis}" for axis in "xyz")

    out = [
        Variable(
            "rotation", 3, "rotation", "rad", components("rotation about hand"), settings.rotation_resolution
        ),
        Variable("translation", 3, "vector", "m", components("lever arm"), settings.translation_resolution),
        Variable("world_rotation", 3, "rotation", "rad", components("rotation of the other world about its")),
        Variable("world_translation", 3, "vector", "m", components("origin of the other world")),
    ]
    if settings.time_offset:
        out.append(Variable("time_offset", 1, unit="s", components=("time offset",)))
    return tuple(out)


__all__ = ["GraspFromPosesNoise", "GraspFromPosesSettings", "GraspPoseFromPoses"]
