"""The rows of the human-dynamics problem: one fixed sparse pattern, filled for all frames at once (mathematics 4.1).

Unknowns of a frame, all in link frames: per link the proper acceleration ``alpha_i`` and the net external wrench ``f_i^x``;
per joint the wrench
``f_j`` of the parent on the child and, where its axes are known, ``qdd_j``. Of the entries only joint transforms and moving axes change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    pose_error_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_rows import SensorRows, sensor_rows
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise
from factorgrasp.problems.human_dynamics_state import (
    MotionAcceleration,
    StateError,
    on_balance,
    on_propagation,
)
from factorgrasp.problems.human_dynamics_terms import DynamicsTerms
from factorgrasp.problems.human_dynamics_writers import (
    Writer,
    flat,
    masked,
    minus_axes,
    minus_transform,
    transposed_transform,
)
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.problems.link_motion_spatial import centripetal, velocity_wrench
from factorgrasp.typing import BoolArray, FloatArray, IntArray
from factorgrasp.uncertainty import Covariance


@dataclass(frozen=True)
class Columns:
    """Where the unknowns of a frame stand.

    Attributes
    ----------
    acceleration : ndarray
        (L, 6); -1 for a fixed base, whose acceleration is given.
    external_wrench : ndarray
        (L, 6).
    joint_wrench : ndarray
        (J, 6).
    joint_acceleration : tuple of ndarray
        (n_j,) by joint, empty without axes.
    """

    acceleration: IntArray
    external_wrench: IntArray
    joint_wrench: IntArray
    joint_acceleration: tuple[IntArray, ...]


class HumanDynamicsSystem:
    """Pattern and values of the rows for one body, set of sensors and noise.

    Parameters
    ----------
    tree : BodyTree
    sensors : sequence of Sensor
    noise : HumanDynamicsNoise
    contacts : sequence of str
        Links that may carry an unmeasured wrench.
    use_motion : bool
        Take the motion's own accelerations (of joints with axes, of a floating root, of links behind joints without axes) as
        measurements where
        no sensor gives them.
    hard_dynamics : bool
        Propagation and balance as equality constraints.
    inequalities : sequence of Constraint
        Rows that :meth:`fill` leaves alone.
    state_errors : bool
        Errors of the configuration are unknowns, too (:mod:`factorgrasp.problems.human_dynamics_state`).
    """

    def __init__(
        self,
        tree: BodyTree,
        sensors: Sequence[Sensor] = (),
        noise: HumanDynamicsNoise | None = None,
        contacts: Sequence[str] = (),
        use_motion: bool = True,
        hard_dynamics: bool = False,
        inequalities: Sequence[Constraint] = (),
        state_errors: bool = False,
    ) -> None:
        self.tree, self.noise, self.hard_dynamics = tree, noise or HumanDynamicsNoise(), hard_dynamics
        self.contacts = tuple(contacts)
        for link in self.contacts:
            if link not in tree.links:
                raise InputError("contacts", "links among " + ", ".join(tree.links), repr(link))
        self.axes = tuple(j for j, dofs in enumerate(tree.dofs) if dofs)
        self.state_errors = state_errors
        self._terms = DynamicsTerms(tree, self.noise, self.contacts, state_errors)
        variables = self._terms.variables()
        self._judged = [not isinstance(sensor, StateError | MotionAcceleration) for sensor in sensors]
        self._sensor_rows: list[SensorRows] = [sensor_rows(tree, sensor, state_errors) for sensor in sensors]
        names = [rows.name for rows in self._sensor_rows]
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise InputError(
                "sensors", "unique names", ", ".join(twice) + " more than once", "Give each its own name="
            )
        dynamics = self._terms.dynamics()
        kinematic = self._terms.kinematic(sensors) if use_motion else []
        measured = [
            Term(
                r.name, r.size, tuple(r.patterns), self._first_covariance(r), pattern=r.patterns, unit=r.unit
            )
            for r in self._sensor_rows
        ]
        terms = [
            *([] if hard_dynamics else dynamics),
            *kinematic,
            *measured,
            *self._terms.zero(sensors),
            *self._terms.prior(variables),
        ]
        hard = (
            [Constraint(t.name, t.rows, t.variables, "equality", t.pattern, t.unit) for t in dynamics]
            if hard_dynamics
            else []
        )
        self.pattern = LeastSquares(variables, terms, [*hard, *inequalities])
        self.columns = self._columns()
        self._prepare()

    # ---- structure --------------------------------------------------------------------------------------------

    @property
    def sensors(self) -> tuple[SensorRows, ...]:
        """The rows of every sensor."""
        return tuple(self._sensor_rows)

    @property
    def marginals(self) -> tuple[IntArray, ...]:
        """Joint wrenches (J), external wrenches (L), joint accelerations, then whatever else a sensor touches."""
        out = [
            *self.columns.joint_wrench,
            *self.columns.external_wrench,
            *(self.columns.joint_acceleration[j] for j in self.axes),
        ]
        known = {tuple(group) for group in out}
        for rows, judged in zip(self._sensor_rows, self._judged, strict=True):
            if not judged:
                continue
            group = self.touched(rows)
            if tuple(group) not in known:
                known.add(tuple(group))
                out.append(group)
        for group in [*self.columns.acceleration, *self.turning.values()]:
            if tuple(group) not in known and group[0] >= 0:
                known.add(tuple(group))
                out.append(group)
        return tuple(out)

    @property
    def turning(self) -> dict[int, IntArray]:
        """By joint whose axes move: its wrench and the errors of its position, which the torques read together."""
        if not self.state_errors:
            return {}
        where = self.pattern.columns
        return {
            j: np.r_[self.columns.joint_wrench[j], where[pose_error_of(self.tree.joints[j])]]
            for j in self.axes
            if self.tree.subspaces[j] is None
        }

    def touched(self, rows: SensorRows) -> IntArray:
        """Unknowns that a sensor's rows touch."""
        return np.concatenate([np.arange(self.pattern.size)[self.pattern.columns[v]] for v in rows.patterns])

    def _columns(self) -> Columns:
        tree, where = self.tree, self.pattern.columns

        def of(name: str, size: int = 6) -> IntArray:
            return np.arange(where[name].start, where[name].stop) if name in where else np.full(size, -1)

        return Columns(
            np.array([of(acceleration_of(link)) for link in tree.links]),
            np.array([of(wrench_on(link)) for link in tree.links]),
            np.array([of(wrench_of(joint)) for joint in tree.joints]).reshape(-1, 6),
            tuple(of(joint_acceleration_of(joint), 0) for joint in tree.joints),
        )

    @staticmethod
    def _first_covariance(rows: SensorRows) -> Covariance:
        """Any covariance of the right kind: a full one couples the pattern of its rows."""
        return (
            Covariance.blocks(np.eye(rows.size))
            if rows.full and rows.size > 1
            else Covariance.diagonal(np.ones(rows.size))
        )

    # ---- places and constants ---------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Everything that does not change, and where the rest goes."""
        tree, soft = self.tree, self.pattern.jacobian
        self._writers: list[tuple[IntArray, Writer]] = []
        self._hard_writers: list[tuple[IntArray, Writer]] = []
        dynamics = self.pattern.equalities if self.hard_dynamics else soft
        writers = self._hard_writers if self.hard_dynamics else self._writers
        pattern = self.pattern

        def put(rows: str, variable: str, value: FloatArray, block: BoolArray | None = None) -> None:
            (dynamics if rows in dynamics.slices else soft).set_block(
                rows, variable, value if block is None else value[block]
            )

        through, up, moving = [], [], []
        for j in self.axes:
            joint = tree.joints[j]
            rows = f"propagation through {joint}"
            put(rows, acceleration_of(tree.links[tree.children[j]]), np.eye(6))
            if not self._terms.given(tree.parents[j]):
                through.append((j, dynamics.places(rows, acceleration_of(tree.links[tree.parents[j]]))))
            S = tree.subspaces[j]
            if S is not None:
                put(rows, joint_acceleration_of(joint), -S)
            else:
                moving.append((j, dynamics.places(rows, joint_acceleration_of(joint))))
            if self.state_errors:
                error, above = pose_error_of(joint), f"balance of {tree.links[tree.parents[j]]}"
                writers.append((dynamics.places(rows, error), flat(on_propagation(tree, j))))
                writers.append((dynamics.places(above, error), flat(on_balance(tree, j))))
        for i, link in enumerate(tree.links):
            rows = f"balance of {link}"
            put(rows, wrench_on(link), -np.eye(6))
            if not self._terms.given(i) and np.any(tree.spatial_inertia[i]):
                put(rows, acceleration_of(link), tree.spatial_inertia[i])
        for j, joint in enumerate(tree.joints):
            put(f"balance of {tree.links[tree.children[j]]}", wrench_of(joint), -np.eye(6))
            up.append((j, dynamics.places(f"balance of {tree.links[tree.parents[j]]}", wrench_of(joint))))
        if moving:
            writers.append(
                (np.concatenate([at for _, at in moving]), minus_axes(tree, [j for j, _ in moving]))
            )
        for pairs, kind in ((through, minus_transform), (up, transposed_transform)):
            if pairs:
                writers.append(
                    (np.concatenate([at for _, at in pairs]), kind(np.array([j for j, _ in pairs])))
                )
        for name, term in pattern.terms.items():
            if name.startswith(("motion: ", "no wrench on ", "unmeasured wrench on ", "prior of ")):
                soft.set_block(name, term.variables[0], np.eye(term.rows))
        for rows_of in self._sensor_rows:
            for variable, value in rows_of.constant.items():
                soft.set_block(rows_of.name, variable, value)
            for variable, make in rows_of.varying.items():
                size = pattern.columns[variable].stop - pattern.columns[variable].start
                full = rows_of.patterns[variable] if not rows_of.full else np.broadcast_to(
                    rows_of.patterns[variable].any(axis=0), (rows_of.size, size)
                )  # fmt: skip
                self._writers.append((soft.places(rows_of.name, variable), masked(make, full)))
        self._fixed = soft.matrix.data.copy()
        self._fixed_hard = pattern.equalities.matrix.data.copy()
        self._layout(soft, dynamics)

    def _layout(self, soft: object, dynamics: object) -> None:
        pattern, tree = self.pattern, self.tree
        where = pattern.equalities.slices if self.hard_dynamics else pattern.jacobian.slices
        self._propagation = _rows(where, [f"propagation through {tree.joints[j]}" for j in self.axes])
        self._balance = _rows(where, [f"balance of {link}" for link in tree.links])
        slices = pattern.jacobian.slices
        self._motion_rows = _rows(
            slices,
            [f"motion: {joint_acceleration_of(tree.joints[j])}" for j in self._terms.motion_joints],
        )
        self._motion_link_rows = _rows(
            slices, [f"motion: {acceleration_of(tree.links[i])}" for i in self._terms.motion_links]
        )
        ends = np.cumsum([0, *(len(tree.dofs[j]) for j in self.axes)])
        at = {j: np.arange(ends[k], ends[k + 1]) for k, j in enumerate(self.axes)}
        chosen = [at[j] for j in self._terms.motion_joints]
        self._motion_dofs: IntArray = np.concatenate([*chosen, np.empty(0, dtype=np.intp)]).astype(np.intp)
        self._sensor_range = _rows(slices, [rows.name for rows in self._sensor_rows])
        indptr = pattern.jacobian.matrix.indptr
        first = self._sensor_range.start
        self._sensor_entries = slice(int(indptr[first]), int(indptr[self._sensor_range.stop]))
        self._sensor_of_entry = pattern.jacobian.row_of_entry[self._sensor_entries] - first
        self.value_slices = tuple(
            slice(slices[r.name].start - first, slices[r.name].stop - first) for r in self._sensor_rows
        )
        placed = [
            (r.placement, where)
            for r, where in zip(self._sensor_rows, self.value_slices, strict=True)
            if r.placement
        ]
        self._imus = None
        if placed:
            self._imus = (
                np.array([p[0] for p, _ in placed], dtype=np.int64), np.array([p[1] for p, _ in placed]), np.array([p[2] for p,
                _ in placed]),
                np.concatenate([np.arange(where.start, where.stop) for _, where in placed]),
            )  # fmt: skip

    # ---- values -----------------------------------------------------------------------------------------------

    def raw(self, k: LinkKinematics, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Non-zeros (n, nnz) and right-hand sides (n, rows) of all terms, not whitened; rows of gaps are zero.

        Parameters
        ----------
        k : LinkKinematics
            Of n frames.
        values : ndarray
            (n, m) of all sensors side by side.
        """
        count, pattern = k.count, self.pattern
        entries = np.empty((count, self._fixed.size))
        entries[:] = self._fixed
        for places, make in self._writers:
            entries[:, places] = make(k)
        rhs = np.zeros((count, pattern.jacobian.height))
        if not self.hard_dynamics:
            rhs[:, self._propagation], rhs[:, self._balance] = self._dynamics_rhs(k)
        rhs[:, self._motion_rows] = k.joint_acceleration[:, self._motion_dofs]
        if self._terms.motion_links:
            rhs[:, self._motion_link_rows] = k.acceleration[:, self._terms.motion_links].reshape(count, -1)
        if not self._sensor_rows:
            return entries, rhs
        right = values.copy()
        if self._imus is not None:
            links, back, arm, at = self._imus
            known = centripetal(k.velocity, links, back, arm)
            right[:, at] -= known.reshape(count, -1)
        # One sum finds a NaN several times faster than isnan.
        if np.isnan(values.sum()):
            gaps = np.isnan(values)
            right[gaps] = 0.0
            part = entries[:, self._sensor_entries]
            part[gaps[:, self._sensor_of_entry]] = 0.0
        rhs[:, self._sensor_range] = right
        return entries, rhs

    def hard(self, k: LinkKinematics) -> tuple[FloatArray, FloatArray]:
        """Non-zeros and right-hand sides of the dynamics as equality constraints."""
        entries = np.empty((k.count, self._fixed_hard.size))
        entries[:] = self._fixed_hard
        for places, make in self._hard_writers:
            entries[:, places] = make(k)
        rhs = np.zeros((k.count, self.pattern.equalities.height))
        rhs[:, self._propagation], rhs[:, self._balance] = self._dynamics_rhs(k)
        return entries, rhs

    def _dynamics_rhs(self, k: LinkKinematics) -> tuple[FloatArray, FloatArray]:
        tree, count = self.tree, k.count
        balance = velocity_wrench(tree.spatial_inertia, k.velocity)
        bias = k.bias
        if tree.fixed_base:
            given = k.acceleration[:, tree.root]
            balance[:, tree.root] -= given @ tree.spatial_inertia[tree.root].T
            bias = bias.copy()
            for j in self.axes:
                if tree.parents[j] == tree.root:
                    bias[:, j] += (k.transform[:, j] @ given[:, :, None])[..., 0]
        if len(self.axes) < len(tree.joints):
            bias = bias[:, list(self.axes)]
        return bias.reshape(count, -1), balance.reshape(count, -1)


def _rows(slices: Mapping[str, slice], names: Sequence[str]) -> slice:
    """The rows of terms that stand one after another."""
    if not names:
        return slice(0, 0)
    return slice(slices[names[0]].start, slices[names[-1]].stop)
