"""The rows of the human-dynamics problem: one fixed sparse pattern, filled for all frames at once (mathematics 4.1).

Unknowns of a frame, all in link frames: per link the proper acceleration ``alpha_i`` and the net external wrench ``f_i^x``;
per joint the wrench
``f_j`` of the parent on the child and, where its axes are known, ``qdd_j``. Of the entries only joint transforms and moving axes change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.least_squares import Constraint, LeastSquares, Term
from factorgrasp.problems.human_dynamics_names import (
    acceleration_of,
    joint_acceleration_of,
    wrench_of,
    wrench_on,
)
from factorgrasp.problems.human_dynamics_rows import SensorRows, sensor_rows
from factorgrasp.problems.human_dynamics_sensors import Sensor
from factorgrasp.problems.human_dynamics_settings import HumanDynamicsNoise, resolve
from factorgrasp.problems.link_motion import BodyTree, LinkKinematics
from factorgrasp.problems.link_motion_spatial import centripetal, velocity_wrench
from factorgrasp.typing import BoolArray, FloatArray, IntArray
from factorgrasp.uncertainty import Covariance
from factorgrasp.variables import Variable

_MOTION = np.ones((6, 6), dtype=bool)
_MOTION[3:, :3] = False
"""Pattern of a motion transform; that of a wrench is its transpose."""

ACCELERATION = ("linear x", "linear y", "linear z", "angular x", "angular y", "angular z")
WRENCH = ("force x", "force y", "force z", "moment x", "moment y", "moment z")

Writer = Callable[[LinkKinematics], FloatArray]


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
    ) -> None:
        self.tree, self.noise, self.hard_dynamics = tree, noise or HumanDynamicsNoise(), hard_dynamics
        self.contacts = tuple(contacts)
        for link in self.contacts:
            if link not in tree.links:
                raise InputError("contacts", "links among " + ", ".join(tree.links), repr(link))
        self.axes = tuple(j for j, dofs in enumerate(tree.dofs) if dofs)
        variables = self._variables()
        self._sensor_rows: list[SensorRows] = [sensor_rows(tree, sensor) for sensor in sensors]
        names = [rows.name for rows in self._sensor_rows]
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise InputError(
                "sensors", "unique names", ", ".join(twice) + " more than once", "Give each its own name="
            )
        dynamics = self._dynamics_terms()
        kinematic = self._kinematic_terms(sensors) if use_motion else []
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
            *self._zero_terms(sensors),
            *self._prior_terms(variables),
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
        for rows in self._sensor_rows:
            group = self.touched(rows)
            if tuple(group) not in known:
                known.add(tuple(group))
                out.append(group)
        for group in self.columns.acceleration:
            if tuple(group) not in known and group[0] >= 0:
                out.append(group)
        return tuple(out)

    def touched(self, rows: SensorRows) -> IntArray:
        """Unknowns that a sensor's rows touch."""
        return np.concatenate([np.arange(self.pattern.size)[self.pattern.columns[v]] for v in rows.patterns])

    def _variables(self) -> list[Variable]:
        tree = self.tree
        out = [
            Variable(acceleration_of(link), 6, unit="m/s^2, rad/s^2", components=ACCELERATION)
            for i, link in enumerate(tree.links)
            if not (tree.fixed_base and i == tree.root)
        ]
        out += [Variable(wrench_on(link), 6, unit="N, Nm", components=WRENCH) for link in tree.links]
        out += [Variable(wrench_of(joint), 6, unit="N, Nm", components=WRENCH) for joint in tree.joints]
        out += [
            Variable(
                joint_acceleration_of(tree.joints[j]),
                len(tree.dofs[j]),
                unit="rad/s^2",
                components=tree.dofs[j],
            )
            for j in self.axes
        ]
        return out

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

    def _dynamics_terms(self) -> list[Term]:
        tree, noise = self.tree, self.noise
        eye = np.eye(6, dtype=bool)
        joints = [tree.joints[j] for j in self.axes]
        propagation = resolve(noise.propagation, joints, [6] * len(joints), "propagation variance")
        balance = resolve(noise.balance, tree.links, [6] * len(tree.links), "balance variance")
        terms = []
        for j, variance in zip(self.axes, propagation, strict=True):
            pattern = {acceleration_of(tree.links[tree.children[j]]): eye}
            if not self._given(tree.parents[j]):
                pattern[acceleration_of(tree.links[tree.parents[j]])] = _MOTION
            S = tree.subspaces[j]
            pattern[joint_acceleration_of(tree.joints[j])] = (
                np.ones((6, len(tree.dofs[j])), dtype=bool) if S is None else S != 0.0
            )
            name = f"propagation through {tree.joints[j]}"
            terms.append(
                Term(
                    name,
                    6,
                    tuple(pattern),
                    Covariance.diagonal(variance),
                    pattern=pattern,
                    unit="m/s^2, rad/s^2",
                )
            )
        for i, link in enumerate(tree.links):
            pattern = {wrench_on(link): eye}
            if not self._given(i) and np.any(tree.spatial_inertia[i]):
                pattern[acceleration_of(link)] = tree.spatial_inertia[i] != 0.0
            for j, joint in enumerate(tree.joints):
                if tree.children[j] == i:
                    pattern[wrench_of(joint)] = eye
                elif tree.parents[j] == i:
                    pattern[wrench_of(joint)] = _MOTION.T
            terms.append(
                Term(
                    f"balance of {link}",
                    6,
                    tuple(pattern),
                    Covariance.diagonal(balance[i]),
                    pattern=pattern,
                    unit="N, Nm",
                )
            )
        return terms

    def _given(self, link: int) -> bool:
        return self.tree.fixed_base and link == self.tree.root

    def _kinematic_terms(self, sensors: Sequence[Sensor]) -> list[Term]:
        tree, noise = self.tree, self.noise
        have = {(sensor.kind, sensor.where) for sensor in sensors}
        self._motion_joints = [j for j in self.axes if ("joint acceleration", tree.joints[j]) not in have]
        behind = {int(tree.children[j]) for j, dofs in enumerate(tree.dofs) if not dofs}
        if not tree.fixed_base:
            behind.add(tree.root)
        self._motion_links = [i for i in sorted(behind) if ("link acceleration", tree.links[i]) not in have]
        names = [tree.joints[j] for j in self.axes]
        spread = resolve(
            noise.joint_acceleration,
            names,
            [len(tree.dofs[j]) for j in self.axes],
            "joint acceleration variance",
        )
        by_joint = dict(zip(self.axes, spread, strict=True))
        by_link = resolve(
            noise.link_acceleration, tree.links, [6] * len(tree.links), "link acceleration variance"
        )
        terms = []
        for j in self._motion_joints:
            name = joint_acceleration_of(tree.joints[j])
            size = len(tree.dofs[j])
            pattern = {name: np.eye(size, dtype=bool)}
            terms.append(
                Term(
                    f"motion: {name}",
                    size,
                    (name,),
                    Covariance.diagonal(by_joint[j]),
                    pattern=pattern,
                    unit="rad/s^2",
                )
            )
        for i in self._motion_links:
            name = acceleration_of(tree.links[i])
            terms.append(
                Term(
                    f"motion: {name}",
                    6,
                    (name,),
                    Covariance.diagonal(by_link[i]),
                    pattern={name: np.eye(6, dtype=bool)},
                )
            )
        return terms

    def _zero_terms(self, sensors: Sequence[Sensor]) -> list[Term]:
        tree = self.tree
        measured = {
            link
            for s in sensors
            if s.kind.startswith("external wrench")
            for link in getattr(s, "links", (s.where,))
        }
        twice = measured & set(self.contacts)
        if twice:
            raise InputError(
                "contacts",
                "links without a wrench sensor",
                ", ".join(sorted(twice)),
                "A measured wrench needs no entry here",
            )
        free = resolve(self.noise.free_wrench, tree.links, [6] * len(tree.links), "free wrench variance")
        loose = resolve(
            self.noise.contact_wrench, tree.links, [6] * len(tree.links), "contact wrench variance"
        )
        terms = []
        for i, link in enumerate(tree.links):
            if link in measured:
                continue
            touched = link in self.contacts
            name = f"unmeasured wrench on {link}" if touched else f"no wrench on {link}"
            pattern = {wrench_on(link): np.eye(6, dtype=bool)}
            variance = loose[i] if touched else free[i]
            terms.append(
                Term(
                    name, 6, (wrench_on(link),), Covariance.diagonal(variance), pattern=pattern, unit="N, Nm"
                )
            )
        return terms

    def _prior_terms(self, variables: Sequence[Variable]) -> list[Term]:
        tree, noise = self.tree, self.noise
        links = [6] * len(tree.links)
        by_name: dict[str, FloatArray] = {}
        for name, variance in zip(
            tree.links,
            resolve(noise.prior_link_acceleration, tree.links, links, "prior variance"),
            strict=True,
        ):
            by_name[acceleration_of(name)] = variance
        for name, variance in zip(
            tree.links, resolve(noise.prior_external_wrench, tree.links, links, "prior variance"), strict=True
        ):
            by_name[wrench_on(name)] = variance
        joints = resolve(noise.prior_joint_wrench, tree.joints, [6] * len(tree.joints), "prior variance")
        for name, variance in zip(tree.joints, joints, strict=True):
            by_name[wrench_of(name)] = variance
        names = [tree.joints[j] for j in self.axes]
        sizes = [len(tree.dofs[j]) for j in self.axes]
        for name, variance in zip(
            names, resolve(noise.prior_joint_acceleration, names, sizes, "prior variance"), strict=True
        ):
            by_name[joint_acceleration_of(name)] = variance
        out = []
        for v in variables:
            covariance = Covariance.diagonal(by_name[v.name])
            pattern = {v.name: np.eye(v.size, dtype=bool)}
            out.append(
                Term(f"prior of {v.name}", v.size, (v.name,), covariance, pattern=pattern, unit=v.unit)
            )
        return out

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
            if not self._given(tree.parents[j]):
                through.append((j, dynamics.places(rows, acceleration_of(tree.links[tree.parents[j]]))))
            S = tree.subspaces[j]
            if S is not None:
                put(rows, joint_acceleration_of(joint), -S)
            else:
                moving.append((j, dynamics.places(rows, joint_acceleration_of(joint))))
        for i, link in enumerate(tree.links):
            rows = f"balance of {link}"
            put(rows, wrench_on(link), -np.eye(6))
            if not self._given(i) and np.any(tree.spatial_inertia[i]):
                put(rows, acceleration_of(link), tree.spatial_inertia[i])
        for j, joint in enumerate(tree.joints):
            put(f"balance of {tree.links[tree.children[j]]}", wrench_of(joint), -np.eye(6))
            up.append((j, dynamics.places(f"balance of {tree.links[tree.parents[j]]}", wrench_of(joint))))
        if moving:
            writers.append(
                (np.concatenate([at for _, at in moving]), _minus_axes(tree, [j for j, _ in moving]))
            )
        for pairs, kind in ((through, _minus_transform), (up, _transposed_transform)):
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
                self._writers.append((soft.places(rows_of.name, variable), _masked(make, full)))
        self._fixed = soft.matrix.data.copy()
        self._fixed_hard = pattern.equalities.matrix.data.copy()
        self._layout(soft, dynamics)

    def _layout(self, soft: object, dynamics: object) -> None:
        pattern, tree = self.pattern, self.tree
        where = pattern.equalities.slices if self.hard_dynamics else pattern.jacobian.slices
        self._propagation = _rows(where, [f"propagation through {tree.joints[j]}" for j in self.axes])
        self._balance = _rows(where, [f"balance of {link}" for link in tree.links])
        slices = pattern.jacobian.slices
        have = hasattr(self, "_motion_joints")
        self._motion_rows = _rows(
            slices,
            [f"motion: {joint_acceleration_of(tree.joints[j])}" for j in self._motion_joints] if have else [],
        )
        self._motion_link_rows = _rows(
            slices, [f"motion: {acceleration_of(tree.links[i])}" for i in self._motion_links] if have else []
        )
        if have:
            ends = np.cumsum([0, *(len(tree.dofs[j]) for j in self.axes)])
            at = {j: np.arange(ends[k], ends[k + 1]) for k, j in enumerate(self.axes)}
            self._motion_dofs = np.concatenate(
                [at[j] for j in self._motion_joints] or [np.empty(0, dtype=np.intp)]
            ).astype(np.intp)
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
        if hasattr(self, "_motion_joints"):
            rhs[:, self._motion_rows] = k.joint_acceleration[:, self._motion_dofs]
            rhs[:, self._motion_link_rows] = k.acceleration[:, self._motion_links].reshape(count, -1)
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


def _minus_axes(tree: BodyTree, joints: Sequence[int]) -> Writer:
    ends = np.cumsum([len(dofs) for dofs in tree.dofs])
    chosen = []
    for j in joints:
        size = len(tree.dofs[j])
        column, row = np.tile(np.arange(ends[j] - size, ends[j]), 6), np.repeat(np.arange(6), size)
        chosen.append(6 * column + row)
    index = np.concatenate(chosen)
    return lambda k: np.negative(k.axes.reshape(k.count, -1).take(index, axis=1))


def _minus_transform(joints: IntArray) -> Writer:
    rows, cols = np.nonzero(_MOTION)
    index = (36 * joints[:, None] + 6 * rows + cols).ravel()
    return lambda k: np.negative(k.transform.reshape(k.count, -1).take(index, axis=1))


def _transposed_transform(joints: IntArray) -> Writer:
    rows, cols = np.nonzero(_MOTION.T)
    index = (36 * joints[:, None] + 6 * cols + rows).ravel()
    return lambda k: k.transform.reshape(k.count, -1).take(index, axis=1)


def _masked(make: Writer, pattern: BoolArray) -> Writer:
    return lambda k: make(k)[:, pattern]
