"""The peer: iDynTree's C++ estimator ``BerdySparseMAPSolver`` on the body, sensors and covariances that we are given.

Floating-base variants. Unknowns and rows are those of mathematics 4.1 with one-degree-of-freedom joints; the order of unknowns is
iDynTree's own.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PeerCovariances:
    """Variances, one for all rows of a kind or six components for wrenches."""

    model: float = 1e-4
    prior: float = 1e6
    joint_acceleration: float = 1e-3
    accelerometer: float = 1e-3
    wrench_default: Any = 1e-4
    wrenches: dict[str, Any] | None = None
    momentum_rate: float = 1e-3


class IDynTreePeer:
    """One body with its sensors.

    Parameters
    ----------
    urdf : str
        The text of the URDF.
    accelerometers : mapping of str to (link, R_l_s, p_l_s)
    covariances : PeerCovariances
    base : str
        Base link.
    non_collocated : bool
        The first task of Tirupachuri 2021: all external wrenches from the centroidal momentum.
    """

    def __init__(
        self, urdf: str, accelerometers: dict[str, tuple[str, np.ndarray, np.ndarray]], covariances: PeerCovariances, base: str,
        joints: list[str] | None = None, non_collocated: bool = False,
    ) -> None:  # fmt: skip
        import idyntree.bindings as idt

        self.idt, self.covariances = idt, covariances
        loader = idt.ModelLoader()
        ok = (
            loader.loadModelFromString(urdf)
            if joints is None
            else loader.loadReducedModelFromString(urdf, joints)
        )
        if not ok:
            raise RuntimeError("iDynTree cannot read the URDF")
        self.model = loader.model().copy()
        sensors = idt.SensorsList()
        self.accelerometers = accelerometers
        for name, (link, R, p) in accelerometers.items():
            sensor = idt.AccelerometerSensor()
            sensor.setName(name)
            sensor.setParentLink(link)
            sensor.setParentLinkIndex(self.model.getLinkIndex(link))
            sensor.setLinkSensorTransform(
                idt.Transform(
                    idt.Rotation.FromPython(np.asarray(R).tolist()), idt.Position(*[float(v) for v in p])
                )
            )
            sensors.addSensor(sensor)
        options = idt.BerdyOptions()
        options.berdyVariant = (
            idt.BERDY_FLOATING_BASE_NON_COLLOCATED_EXT_WRENCHES if non_collocated else idt.BERDY_FLOATING_BASE
        )
        options.includeAllNetExternalWrenchesAsSensors = True
        options.includeAllNetExternalWrenchesAsDynamicVariables = True
        options.includeAllJointAccelerationsAsSensors = not non_collocated
        options.includeAllJointTorquesAsSensors = False
        options.includeFixedBaseExternalWrench = True
        options.baseLink = base
        self.helper = idt.BerdyHelper()
        self._keep = (sensors, options)
        if not self.helper.init(self.model, sensors, options):
            raise RuntimeError("iDynTree does not take the model")
        self.base = self.model.getFrameIndex(base)
        self.base_link = self.model.getLinkIndex(base)
        self.solver = idt.BerdySparseMAPSolver(self.helper)
        self.solver.initialize()
        self.size = self.helper.getNrOfDynamicVariables()
        self.rows = self.helper.getNrOfDynamicEquations()
        self.measured = self.helper.getNrOfSensorsMeasurements()
        self._set_covariances()

    def _diagonal(self, values: np.ndarray) -> Any:
        matrix = self.idt.SparseMatrixColMajor(len(values), len(values))
        for i, v in enumerate(values):
            matrix.setValue(i, i, float(v))
        return matrix

    def _set_covariances(self) -> None:
        c = self.covariances
        variance = np.full(self.measured, np.nan)
        self.ranges: dict[tuple[str, str], slice] = {}
        for sensor in self.helper.getSensorsOrdering():
            where = slice(sensor.range.offset, sensor.range.offset + sensor.range.size)
            kind = {
                self.idt.NET_EXT_WRENCH_SENSOR: "wrench",
                self.idt.DOF_ACCELERATION_SENSOR: "joint",
                self.idt.ACCELEROMETER_SENSOR: "accelerometer",
            }.get(sensor.type, "momentum")
            self.ranges[kind, sensor.id] = where
            if kind == "wrench":
                variance[where] = (c.wrenches or {}).get(sensor.id, c.wrench_default)
            else:
                variance[where] = {"joint": c.joint_acceleration, "accelerometer": c.accelerometer}.get(
                    kind, c.momentum_rate
                )
        self.sensor_variance = variance
        if self.rows:
            self.solver.setDynamicsConstraintsPriorCovariance(self._diagonal(np.full(self.rows, c.model)))
        self.solver.setDynamicsRegularizationPriorCovariance(self._diagonal(np.full(self.size, c.prior)))
        self.solver.setDynamicsRegularizationPriorExpectedValue(
            self.idt.VectorDynSize.FromPython([0.0] * self.size)
        )
        self.solver.setMeasurementsPriorCovariance(self._diagonal(variance))

    def measurement(
        self,
        wrenches: dict[str, np.ndarray],
        qdd: dict[str, float],
        specific: dict[str, np.ndarray],
        momentum: np.ndarray | None = None,
    ) -> np.ndarray:
        """The vector y in iDynTree's order."""
        y = np.zeros(self.measured)
        for (kind, name), where in self.ranges.items():
            if kind == "wrench":
                y[where] = wrenches.get(name, 0.0)
            elif kind == "joint":
                y[where] = qdd[name]
            elif kind == "accelerometer":
                y[where] = specific[name]
            elif momentum is not None:
                y[where] = momentum
        return y

    def estimate(
        self, q: np.ndarray, qd: np.ndarray, base_rate: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Unknowns d in iDynTree's order and the processor's seconds spent in iDynTree."""
        idt = self.idt
        jq, jv = idt.JointPosDoubleArray(self.model), idt.JointDOFsDoubleArray(self.model)
        for i in range(q.size):
            jq.setVal(i, float(q[i]))
            jv.setVal(i, float(qd[i]))
        rate, measured = idt.Vector3.FromPython(base_rate.tolist()), idt.VectorDynSize.FromPython(y.tolist())
        started = time.process_time()
        self.solver.updateEstimateInformationFloatingBase(jq, jv, self.base, rate, measured)
        if not self.solver.doEstimate():
            raise RuntimeError("iDynTree did not solve")
        seconds = time.process_time() - started
        out = idt.VectorDynSize(self.size)
        self.solver.getLastEstimate(out)
        return out.toNumPy().copy(), seconds

    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """D, b_D, Y, b_Y of the last update, dense."""
        idt = self.idt
        D, Y, bD, bY = idt.MatrixDynSize(), idt.MatrixDynSize(), idt.VectorDynSize(), idt.VectorDynSize()
        self.helper.resizeAndZeroBerdyMatrices(D, bD, Y, bY)
        if not self.helper.getBerdyMatrices(D, bD, Y, bY):
            raise RuntimeError("iDynTree gives no matrices")
        return D.toNumPy().copy(), bD.toNumPy().copy(), Y.toNumPy().copy(), bY.toNumPy().copy()

    def unknowns(self) -> dict[tuple[str, str], slice]:
        """Where the unknowns stand, by kind ("acceleration", "external", "wrench", "joint") and name of link or joint."""
        idt = self.idt
        kinds = {
            idt.LINK_BODY_PROPER_ACCELERATION: "acceleration",
            idt.LINK_BODY_PROPER_CLASSICAL_ACCELERATION: "acceleration",
            idt.NET_EXT_WRENCH: "external",
            idt.JOINT_WRENCH: "wrench",
            idt.DOF_ACCELERATION: "joint",
        }
        return {
            (kinds[v.type], v.id): slice(v.range.offset, v.range.offset + v.range.size)
            for v in self.helper.getDynamicVariablesOrdering()
        }
