"""Excitation: robot motions that reveal the grasp and spare the human's wrist (Cehajic 2015, III.C and IV; mathematics 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.models.motion_basis import make_basis
from factorgrasp.problems import excitation_expressions as expressions
from factorgrasp.problems.excitation_human import HumanMotion
from factorgrasp.problems.excitation_node import NodeFunction
from factorgrasp.problems.excitation_program import CoordinateLimit, PathLimit, TrajectoryProgram, Windows
from factorgrasp.problems.excitation_settings import (
    ExcitationSettings,
    GraspBelief,
    HumanWrist,
    RobotLimits,
    sensor_densities,
)
from factorgrasp.problems.excitation_space import PlanSpace, joint_space, task_space
from factorgrasp.problems.grasp_settings import GraspNoise
from factorgrasp.typing import FloatArray

GRAVITY = np.array([0.0, 0.0, -9.80665])
PANELS = 6
"""Panels of the quadrature per period of the bandwidth, two Gauss points each."""
TIGHTER = 1e-3
"""Share of a limit that is kept free at the instants at which it is imposed, so that it holds between them."""
DENSE = 16
"""Instants per period of the bandwidth at which a coordinate's limit is imposed once it was violated anywhere."""
TOLERANCE = 1e-6
"""Violation, relative to a limit's range, below which it counts as rounding."""


@dataclass(frozen=True, eq=False)
class ArmTask:
    """The robot that shall move: a chain of revolute or prismatic joints.

    Attributes
    ----------
    robot : CasadiRobot
    frame : str
        The end-effector's.
    limits : RobotLimits
    start : ndarray (n,)
        Joint positions at the start.
    goal : ndarray (n,) or None
        At the end, when the human's wrist ends elsewhere.
    spheres, pairs : tuple
        For the distance between links, see :func:`factorgrasp.problems.excitation_space.joint_space`.
    others : tuple
        Pairs that only the finished plan is checked for, and that are planned with when it brings them too near.
    """

    robot: Any
    frame: str
    limits: RobotLimits
    start: FloatArray
    goal: FloatArray | None = None
    spheres: tuple[tuple[int, FloatArray, float], ...] = ()
    pairs: tuple[tuple[int, int, str], ...] = ()
    others: tuple[tuple[int, int, str], ...] = ()


@dataclass(frozen=True)
class Points:
    """Where limits and windows are imposed so far.

    Attributes
    ----------
    coordinates : frozenset of (index into the coordinate bounds, time)
    path : frozenset of (index into the path bounds, time)
    windows : frozenset of int
        First panel of a window.
    tighter : float
        By what the excitation that is asked for is larger than what has to be shown on the fine grid.
    """

    coordinates: frozenset[tuple[int, float]] = frozenset()
    path: frozenset[tuple[int, float]] = frozenset()
    windows: frozenset[int] = frozenset()
    tighter: float = 1.0


@dataclass(frozen=True)
class Margin:
    """How near a plan comes to a limit.

    Attributes
    ----------
    name, unit : str
    value, limit : float
        The worst value, and the bound that it is nearest to.
    margin : float
        What is left, negative when the limit is violated.
    time : float
        s.
    relative : float
        `margin` over the range of the limit.
    """

    name: str
    unit: str
    value: float
    limit: float
    margin: float
    time: float
    relative: float


@dataclass(frozen=True, eq=False)
class PlanCheck:
    """What the fine grid shows of a plan.

    Attributes
    ----------
    margins : tuple of Margin
    window_start : ndarray
        s, of every window on the grid.
    window_share : ndarray
        Excitation of each over what is asked for (the least eigenvalue, or the least ratio of a variance to its target's).
    points : Points
        Those of the program, and where it has to be held tighter.
    """

    margins: tuple[Margin, ...]
    window_start: FloatArray
    window_share: FloatArray
    points: Points

    @property
    def share(self) -> float:
        """Of the worst window."""
        return float(np.min(self.window_share))

    @property
    def violated(self) -> tuple[Margin, ...]:
        """Limits that do not hold."""
        return tuple(one for one in self.margins if one.relative < -TOLERANCE)


class Excitation:
    """Plan of a motion that reveals the grasp.

    Parameters
    ----------
    grasp : GraspBelief
    human : HumanMotion
    settings : ExcitationSettings
    wrist : HumanWrist, optional
    noise : GraspNoise, optional
        Of the sensors that will watch, for targets that are standard deviations.
    arm : ArmTask, optional
        Without it the plan is one in task space alone.
    box : (lower, upper), optional
        m; of the end-effector's origin, when there is no robot that says it.
    gravity : (3,) ndarray, optional
    start_motion : (3, m) ndarray, optional
        Rotation vector about the wrist, its rate and its acceleration at the start, in place of rest (for a plan that takes over from
        another).
    """

    kind = "excitation"

    def __init__(
        self,
        grasp: GraspBelief,
        human: HumanMotion,
        settings: ExcitationSettings,
        wrist: HumanWrist | None = None,
        noise: GraspNoise | None = None,
        arm: ArmTask | None = None,
        box: tuple[FloatArray, FloatArray] | None = None,
        gravity: FloatArray = GRAVITY,
        start_motion: FloatArray | None = None,
    ) -> None:
        self.grasp, self.human, self.settings, self.arm = grasp, human, settings, arm
        self.wrist, self.noise = wrist or HumanWrist(), noise or GraspNoise()
        if abs(human.duration - settings.duration) > 1e-9:
            raise InputError("human", f"a motion of {settings.duration:g} s", f"one of {human.duration:g} s")
        if settings.axes == "travel" and not np.any(human.axis(np.array([0.5 * settings.duration]))):
            raise InputError("excitation.axes", '"free", as the wrist does not travel', '"travel"')
        if arm is not None and arm.limits.box_lower is not None and arm.limits.box_upper is not None:
            box = (arm.limits.box_lower, arm.limits.box_upper)
        self.gravity, self._start_motion = np.asarray(gravity, dtype=float), start_motion
        self.basis = make_basis(settings.basis, settings.duration, settings.bandwidth)
        self.task = task_space(
            grasp, self.wrist, human, settings, self.basis, self.gravity, box, start_motion
        )
        self.panel, self._panels = self._panel_length()
        self.nodes, self.node_weights = _gauss(self.panel, self._panels)
        self.grid = np.linspace(
            0.0, settings.duration, int(np.ceil(settings.duration / settings.step - 1e-9)) + 1
        )
        self._grid_values: dict[int, FloatArray] = {}

    def with_arm(self, arm: ArmTask) -> Excitation:
        """The same with another arm."""
        return Excitation(
            self.grasp, self.human, self.settings, self.wrist, self.noise, arm, gravity=self.gravity, start_motion=self._start_motion
        )  # fmt: skip

    @cached_property
    def joint(self) -> PlanSpace:
        """The space of the robot's joints."""
        assert self.arm is not None
        arm = self.arm
        goal = arm.start if arm.goal is None else arm.goal
        return joint_space(
            arm.robot, arm.frame, arm.limits, self.grasp, self.wrist, self.human, self.settings, self.basis, (arm.start, goal),
            arm.spheres, arm.pairs,
        )  # fmt: skip

    # ---- programs -------------------------------------------------------------------------------------------------

    def nonlinear_program(self) -> TrajectoryProgram:
        """The plan in task space from its deterministic start: what solvers are compared on."""
        return self.program(self.task, self.first_points(self.task), self.start())

    def first_points(self, space: PlanSpace) -> Points:
        """Windows a quarter of their length apart; path limits at four instants a period, others where they turn out to matter."""
        length = self._window_panels
        last = self._panels - length
        stride = max(1, length // 4)
        windows = frozenset([*range(0, last + 1, stride), last])
        path: set[tuple[int, float]] = set()
        if space.name == "task":
            count = max(2, int(np.ceil(4.0 * self.settings.duration * self.settings.bandwidth)))
            times = (
                np.linspace(0.0, self.settings.duration, count + 1)[:-1]
                + 0.5 * self.settings.duration / count
            )
            path = {(k, float(time)) for k in range(len(space.path_bounds)) for time in times}
        return Points(frozenset(), frozenset(path), windows)

    def program(self, space: PlanSpace, points: Points, start: FloatArray) -> TrajectoryProgram:
        """The nonlinear program with limits at `points`."""
        limits = []
        for index, time in sorted(points.coordinates):
            bound = space.coordinate_bounds[index]
            less = TIGHTER * bound.scale
            limits.append(
                CoordinateLimit(
                    bound.coordinate, bound.order, time, bound.lower + less, bound.upper - less, bound.scale,
                    f"{bound.name} (limits {bound.lower:.4g} and {bound.upper:.4g} {bound.unit})",
                )
            )  # fmt: skip
        path_limits = []
        for index, time in sorted(points.path):
            one = space.path_bounds[index]
            less = TIGHTER * one.scale
            path_limits.append(
                PathLimit(index, time, one.lower + less, one.upper - less, one.scale, one.name)
            )
        scale = self.energy_scale
        return TrajectoryProgram(
            space.motion, self.nodes, space.integrand, self.node_weights / (self.settings.duration * scale),
            self._windows(points), limits, space.path, path_limits, space.fixed, start, space.reach,
        )  # fmt: skip

    def start(self, seed: int | None = None) -> FloatArray:
        """Coefficients to start from, as strong as asked for: turning about all axes at the highest frequencies, or at random."""
        space, nb = self.task, self.basis.size
        m = space.motion.coordinates
        if seed is None:
            C = np.zeros((m, nb))
            last = nb - 1
            for j in range(m):
                C[j, max(last - j, 0)] = 1.0
                C[j, max(last - j - 3, 0)] += 0.3
            if self.settings.basis == "bspline":
                signs = np.cos(np.pi * np.arange(nb))
                C = np.stack(
                    [signs * np.roll(np.sin(np.pi * np.arange(nb) / nb) ** 2, j * nb // 4) for j in range(m)]
                )
        else:
            C = np.random.default_rng(seed).normal(size=(m, nb))
        C = self._meeting_fixed(space, C, zero=True)
        if not np.any(C):
            return self._meeting_fixed(space, C)
        C = C / np.max(np.linalg.norm(space.motion.at(C, self.nodes, 1)[0], axis=0))
        base = self._meeting_fixed(space, np.zeros((m, nb)))
        most = 0.9 * (self.wrist.largest_turn or 1.0)
        points = replace(self.first_points(space), path=frozenset())
        program = self.program(space, points, C)
        low, high = 0.0, most
        for _ in range(12):
            middle = 0.5 * (low + high)
            if self._least_share(program, base + middle * C) < 1.0:
                low = middle
            else:
                high = middle
        return np.asarray(base + max(high, 0.02) * C)

    @cached_property
    def energy_scale(self) -> float:
        """Mean energy of turning by a tenth of a radian all the time: objectives are in units of it."""
        return (0.1 * self.wrist.moment_stiffness / self.wrist.comfort_moment) ** 2

    def fit(self, space: PlanSpace, t: FloatArray, x: FloatArray) -> FloatArray:
        """Coefficients of the motion that is nearest to samples x (m, n), and meets the conditions at the ends."""
        difference = (x - space.motion.offset(t)[0]).T
        B = space.motion.basis.values(t).T
        rows = [space.motion.basis.values(np.array([time]), order)[:, 0] for time, order, _ in space.fixed]
        targets = [target for _, _, target in space.fixed]
        scale = [np.max(np.abs(row)) for row in rows]
        heavy = 1e4
        A = np.vstack([B, *[heavy * row[None] / s for row, s in zip(rows, scale, strict=True)]])
        b = np.vstack(
            [difference, *[heavy * target[None] / s for target, s in zip(targets, scale, strict=True)]]
        )
        return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0].T)

    # ---- the fine grid --------------------------------------------------------------------------------------------

    def on_grid(self, space: PlanSpace, C: FloatArray, order: int) -> FloatArray:
        """(m, n): a derivative of the coordinates on the fine grid."""
        if order not in self._grid_values:
            self._grid_values[order] = self.basis.values(self.grid, order)
        return np.asarray(C @ self._grid_values[order] + space.motion.offset(self.grid)[order])

    def eased(self, points: Points, share: float) -> Points:
        """The same limits with `share` of the demand."""
        return replace(points, tighter=points.tighter * share)

    def check(self, space: PlanSpace, C: FloatArray, points: Points, needed: float = 1.0) -> PlanCheck:
        """All limits and all windows on the fine grid, and where the program has to be held tighter."""
        t = self.grid
        z = np.concatenate([self.on_grid(space, C, order) for order in range(3)])
        given = space.motion.given(t)
        margins: list[Margin] = []
        coordinates, path = set(points.coordinates), set(points.path)
        for index, bound in enumerate(space.coordinate_bounds):
            value = self.on_grid(space, C, bound.order)[bound.coordinate]
            margin, worst = _margin(
                t, value, bound.lower, bound.upper, bound.scale, bound.name, bound.unit, False
            )
            margins.append(margin)
            if worst:
                # These rows are linear: the whole of a limit that binds costs less than the rounds in which its instants move about.
                coordinates |= {(index, float(time)) for time in self._dense}
            coordinates |= {(index, float(t[k])) for k in worst}
        if space.path is not None:
            h = space.path.values(z, given)
            for index, one in enumerate(space.path_bounds):
                margin, worst = _margin(
                    t, h[:, index], one.lower, one.upper, one.scale, one.name, one.unit, one.root
                )
                margins.append(margin)
                path |= {(index, float(t[k])) for k in worst}
        starts, shares = self._grid_windows(space, z, given)
        windows, tighter = set(points.windows), points.tighter
        if needed > 0.0 and np.min(shares) < needed:
            worst_start = float(starts[int(np.argmin(shares))])
            near = {
                int(np.clip(k, 0, self._panels - self._window_panels))
                for k in (np.floor(worst_start / self.panel), np.ceil(worst_start / self.panel))
            }
            if near <= windows:
                tighter *= (1.0 + 5e-4) * needed / max(float(np.min(shares)), 0.5 * needed)
            windows |= near
        # Several spheres stand for one link: of limits of one name the nearest speaks.
        margins.sort(key=lambda one: one.relative)
        worst_of = {one.name: one for one in reversed(margins)}
        return PlanCheck(
            tuple(sorted(worst_of.values(), key=lambda one: one.relative)),
            starts,
            shares,
            Points(frozenset(coordinates), frozenset(path), frozenset(windows), tighter),
        )

    @cached_property
    def _dense(self) -> FloatArray:
        """Instants between which a motion of the bandwidth cannot exceed a limit by much, s."""
        s = self.settings
        return np.linspace(0.0, s.duration, 1 + int(np.ceil(DENSE * s.duration * s.bandwidth)))

    def near_pairs(self, C: FloatArray) -> tuple[tuple[int, int, str], ...]:
        """Of the arm's other pairs, those that a plan in joint space brings nearer than allowed anywhere on the grid."""
        arm = self.arm
        if arm is None or arm.limits.collision_distance is None or not arm.others:
            return ()
        from factorgrasp.problems.excitation_arm import sphere_places

        q = self.on_grid(self.joint, C, 0)
        places, near = sphere_places(arm.robot, arm.spheres, q), []
        for i, j, words in arm.others:
            least = arm.spheres[i][2] + arm.spheres[j][2] + arm.limits.collision_distance
            if np.min(np.sum((places[:, i] - places[:, j]) ** 2, axis=1)) < least**2:
                near.append((i, j, words))
        return tuple(near)

    def excitation_matrix(self, space: PlanSpace, C: FloatArray, start: float, end: float) -> FloatArray:
        """(3, 3) ``int phi' phi dt`` between two times of the grid, centred where the settings say so."""
        moments = self._grid_moments(space, C)
        a, b = (int(np.argmin(np.abs(self.grid - time))) for time in (start, end))
        s = (moments[b] - moments[a])[:, None]
        import casadi as ca

        symbol = ca.SX.sym("s", space.integrand.size_out)
        made = expressions.centred_excitation(
            symbol, float(self.grid[b] - self.grid[a]), 1.0, self.settings.centred
        )
        values = NodeFunction("G", symbol, ca.SX.sym("p", 0), made).values(s, np.empty((0, 1)))[0]
        return np.asarray(_full(values[None])[0])

    def predicted_information(self, space: PlanSpace, C: FloatArray) -> FloatArray:
        """(6, 6) about [turn about the axes of r, lever arm] after the whole motion, what was known before included."""
        z = np.concatenate([self.on_grid(space, C, order) for order in range(3)])
        read = space.read.values(z, space.motion.given(self.grid))
        return information_of(read, self.grid, self.sensor_noise, self.grasp.information_r)

    # ---- parts ----------------------------------------------------------------------------------------------------

    @property
    def sensor_noise(self) -> expressions.SensorNoise:
        """Of the residuals of the grasp estimator."""
        gyro, accelerometer = sensor_densities(self.noise, self.grasp.translation)
        return expressions.SensorNoise(
            gyro, accelerometer, self.noise.gyro_bias_sd, self.noise.accelerometer_bias_sd
        )

    @property
    def _window_panels(self) -> int:
        return min(round(self.settings.window_length / self.panel), self._panels)

    def _panel_length(self) -> tuple[float, int]:
        """Panels of which a window and the duration hold whole numbers, as far as that can be."""
        s = self.settings
        least = PANELS * s.bandwidth
        # At a human's own motion the integrand is as fast as that motion, too.
        for count in range(
            int(np.ceil(least * s.window_length)), int(np.ceil(2.0 * least * s.window_length)) + 1
        ):
            panel = s.window_length / count
            if abs(s.duration / panel - round(s.duration / panel)) < 1e-6:
                return panel, round(s.duration / panel)
        count = int(np.ceil(least * s.duration))
        return s.duration / count, count

    def _windows(self, points: Points) -> Windows:
        length = self._window_panels
        firsts = sorted(points.windows)
        weights = np.zeros((len(firsts), self.nodes.size))
        for row, first in enumerate(firsts):
            inside = slice(2 * first, 2 * (first + length))
            weights[row, inside] = self.node_weights[inside]
        words = tuple(
            f"excitation between {first * self.panel:.2f} s and {(first + length) * self.panel:.2f} s"
            for first in firsts
        )
        return Windows(weights, self._condition(points.tighter), self.settings.alpha is not None, words)

    def _condition(self, tighter: float) -> NodeFunction:
        import casadi as ca

        if self.settings.alpha is not None:
            s = ca.SX.sym("s", self.task.integrand.size_out)
            made = expressions.centred_excitation(
                s, self.settings.window_length, self.settings.alpha * tighter, self.settings.centred
            )
        else:
            s = ca.SX.sym("s", expressions.MOMENTS)
            information = expressions.grasp_information(
                s, self.sensor_noise, self.settings.duration, self.grasp.information_r
            )
            made = expressions.variance_ratios(information, self.settings.targets) / tighter
        return NodeFunction("condition", s, ca.SX.sym("p", 0), ca.cse(made))

    def _grid_moments(self, space: PlanSpace, C: FloatArray) -> FloatArray:
        z = np.concatenate([self.on_grid(space, C, order) for order in range(3)])
        return _cumulative(self.grid, space.integrand.values(z, space.motion.given(self.grid)))

    def _grid_windows(
        self, space: PlanSpace, z: FloatArray, given: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        total = _cumulative(self.grid, space.integrand.values(z, given))
        length = round(self.settings.window_length / (self.grid[1] - self.grid[0]))
        inside = (total[length:] - total[: total.shape[0] - length]).T
        values = self._grid_condition.values(inside, np.empty((0, inside.shape[1])))
        shares = (
            np.linalg.eigvalsh(_full(values))[:, 0]
            if self.settings.alpha is not None
            else np.min(values, axis=1)
        )
        return self.grid[: inside.shape[1]], np.asarray(shares, dtype=np.float64)

    @cached_property
    def _grid_condition(self) -> NodeFunction:
        return self._condition(1.0)

    def _least_share(self, program: TrajectoryProgram, C: FloatArray) -> float:
        values = program.excitation(program.point(C))
        return float(
            np.min(np.linalg.eigvalsh(_full(values))) if self.settings.alpha is not None else np.min(values)
        )

    def _meeting_fixed(self, space: PlanSpace, C: FloatArray, zero: bool = False) -> FloatArray:
        """The nearest coefficients that meet the conditions at the ends (with zero targets when `zero`)."""
        if not space.fixed:
            return C
        A = np.stack([self.basis.values(np.array([time]), order)[:, 0] for time, order, _ in space.fixed])
        b = np.stack([np.zeros(C.shape[0]) if zero else target for _, _, target in space.fixed])
        scale = np.max(np.abs(A), axis=1, keepdims=True)
        return np.asarray(C - (np.linalg.pinv(A / scale) @ ((A @ C.T - b) / scale)).T)


def information_of(
    read: FloatArray, t: FloatArray, noise: expressions.SensorNoise, prior: FloatArray
) -> FloatArray:
    """Information (6, 6) of a motion whose instants were read (n, 25) by :class:`PlanSpace`."""
    import casadi as ca

    moments = np.concatenate([np.zeros((t.size, 1)), *_moment_columns(read)], axis=1)
    s = np.trapezoid(moments, t, axis=0)
    return np.asarray(expressions.grasp_information(ca.DM(s), noise, float(t[-1] - t[0]), prior).full())


def _moment_columns(read: FloatArray) -> list[FloatArray]:
    from factorgrasp import lie

    w, al, f = read[:, 12:15], read[:, 15:18], read[:, 18:21]
    phi = lie.skew(al) + lie.skew(w) @ lie.skew(w)
    upper = np.triu_indices(3)
    cross = np.swapaxes(lie.skew(f), 1, 2) @ phi
    return [
        (np.swapaxes(phi, 1, 2) @ phi)[:, upper[0], upper[1]], al, (w[:, :, None] * w[:, None])[:, upper[0], upper[1]], w,
        (f[:, :, None] * f[:, None])[:, upper[0], upper[1]], f, cross.transpose(0, 2, 1).reshape(-1, 9),
    ]  # fmt: skip


def _gauss(panel: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Two Gauss points a panel, and their weights."""
    middle = (np.arange(count) + 0.5) * panel
    away = 0.5 * panel / np.sqrt(3.0)
    return np.stack([middle - away, middle + away], axis=1).ravel(), np.full(2 * count, 0.5 * panel)


def _cumulative(t: FloatArray, values: FloatArray) -> FloatArray:
    steps = 0.5 * np.diff(t)[:, None] * (values[1:] + values[:-1])
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def _full(upper: FloatArray) -> FloatArray:
    """(n, 3, 3) from upper triangles (n, 6)."""
    index = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    return np.asarray(upper[:, index])


def _margin(
    t: FloatArray,
    value: FloatArray,
    lower: float,
    upper: float,
    scale: float,
    name: str,
    unit: str,
    root: bool,
) -> tuple[Margin, list[int]]:
    """The margin of one limit, and the worst instant of every stretch that violates it."""
    left = np.minimum(value - lower, upper - value)
    k = int(np.argmin(left))
    at_upper = upper - value[k] <= value[k] - lower
    limit, found = (upper if at_upper else lower), float(value[k])
    if root:
        limit, found = float(np.sqrt(max(limit, 0.0))), float(np.sqrt(max(found, 0.0)))
    margin = limit - found if at_upper else found - limit
    bad = left < -TOLERANCE * scale
    worst = []
    if bad.any():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
        worst = [int(a + np.argmin(left[a:b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    reach = abs(limit) if root else scale
    return Margin(name, unit, found, limit, margin, float(t[k]), margin / (reach or 1.0)), worst
