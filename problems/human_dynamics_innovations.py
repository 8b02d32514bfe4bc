"""Does a sensor agree with what all the others say of it? Innovations, their normalised squares (NIS), and covariances proposed from them.

With the residual ``r = y - Y d`` of the estimate from all sensors and its covariance ``M = R - Y P Y'``, the innovation of leaving the
sensor out is ``R M^-1 r`` with covariance ``R M^-1 R``, so that ``NIS = r' M^-1 r``. Directions that nothing but the sensor itself informs
(M near zero against R) cannot be judged; they are left out of the NIS and of its degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgrasp.problems.human_dynamics_rows import SensorRows
from factorgrasp.problems.link_motion import LinkKinematics
from factorgrasp.typing import FloatArray, IntArray
from factorgrasp.uncertainty import nees_band

if TYPE_CHECKING:
    from factorgrasp.problems.human_dynamics import HumanDynamics

JUDGED_FROM = 1e-6
"""Share of a sensor's variance that must be checked by others for a direction to count."""


@dataclass(frozen=True)
class Innovation:
    """Agreement of one sensor over n frames.

    Attributes
    ----------
    name, unit : str
    residual : ndarray
        (n, k) ``y - Y d - b_Y`` in the unit of the sensor; NaN in gaps.
    nis : ndarray
        (n,) normalised innovation squared.
    dof : ndarray
        (n,) its degrees of freedom: components that the others can check.
    redundancy : ndarray
        (k,) mean share (0 to 1) of each component's variance that the others check: 0 means that nobody else informs it.
    """

    name: str
    unit: str
    residual: FloatArray
    nis: FloatArray
    dof: IntArray
    redundancy: FloatArray

    @property
    def ratio(self) -> float:
        """Mean NIS per degree of freedom: 1 when the covariance fits, above when it is too small; NaN when nothing can be checked."""
        total = float(self.dof.sum())
        return float(np.nansum(self.nis)) / total if total else float("nan")

    def band(self, effective: float = 1.0, probability: float = 0.95) -> tuple[float, float]:
        """Band of :attr:`ratio` for `effective` (0 to 1) independent frames of all; errors that last over frames make it wider."""
        frames = max(int(np.count_nonzero(self.dof) * effective), 1)
        mean_dof = float(self.dof.sum()) / max(int(np.count_nonzero(self.dof)), 1)
        return nees_band(1, max(round(frames * mean_dof), 1), probability)


def innovations(problem: HumanDynamics, k: LinkKinematics, result: Any) -> tuple[Innovation, ...]:
    """One a sensor, from the estimate and its marginal covariances."""
    system = problem.system
    known = {
        tuple(int(v) for v in group): block
        for group, block in zip(system.marginals, result.marginals, strict=True)
    }
    out = []
    # Rows of the motion's own noise stand behind the sensors.
    for i, (rows, sensor) in enumerate(zip(system.sensors, problem.sensors, strict=False)):
        group = system.touched(rows)
        P = known[tuple(int(v) for v in group)]
        out.append(_innovation(rows, k, sensor.values, sensor.variances(), result.x[:, group], P, i))
    return tuple(out)


def _innovation(
    rows: SensorRows,
    k: LinkKinematics,
    values: FloatArray,
    covariance: FloatArray,
    x: FloatArray,
    P: FloatArray,
    _: int,
) -> Innovation:
    Y = rows.jacobian(k)
    measured = values if rows.offset is None else values - rows.offset(k)
    residual = measured - (Y @ x[..., None])[..., 0]
    diagonal = covariance.ndim == 1 or (covariance.ndim == 2 and not rows.full)
    R = covariance[..., None] * np.eye(rows.size) if diagonal else covariance
    gaps = np.isnan(residual)
    R = np.where(gaps[:, :, None] | gaps[:, None, :], np.eye(rows.size), R)
    W = np.linalg.inv(np.linalg.cholesky(R))
    seen = W @ np.where(gaps[:, :, None], 0.0, Y)
    M = np.eye(rows.size) - seen @ P @ np.swapaxes(seen, -1, -2)
    e = (W @ np.where(gaps, 0.0, residual)[..., None])[..., 0]
    broken = ~np.all(np.isfinite(M), axis=(1, 2))
    M[broken] = 0.0
    share, axes = np.linalg.eigh(0.5 * (M + np.swapaxes(M, -1, -2)))
    along = (np.swapaxes(axes, -1, -2) @ e[..., None])[..., 0]
    # A gap has a row of its own with share one and nothing along it: not to be counted.
    real = (np.swapaxes(axes, -1, -2) ** 2 @ (~gaps)[..., None].astype(float))[..., 0] > 0.5
    judged = (share > JUDGED_FROM) & real & ~broken[:, None]
    nis = np.sum(np.where(judged, along**2 / np.where(judged, share, 1.0), 0.0), axis=1)
    diag = np.where(gaps | broken[:, None], np.nan, np.diagonal(M, axis1=1, axis2=2))
    counted = np.maximum(np.sum(np.isfinite(diag), axis=0), 1)
    return Innovation(
        rows.name, rows.unit, residual, nis, judged.sum(axis=1), np.nansum(diag, axis=0) / counted
    )


@dataclass(frozen=True)
class CovarianceProposal:
    """Variances that would make a sensor's innovations as large as they are.

    Attributes
    ----------
    name : str
    current, proposed : ndarray
        (k,) variances in squared units of the sensor; NaN where nothing else informs the component.
    samples : float
        Independent samples that the proposal rests on, judged from how long the residuals stay alike.
    sd : ndarray
        (k,) relative standard deviation of the proposed variance from that number alone.
    words : str
        What stands against using it.
    """

    name: str
    current: FloatArray
    proposed: FloatArray
    samples: float
    sd: FloatArray
    words: str


def propose_covariances(problem: HumanDynamics, estimate: Any) -> tuple[CovarianceProposal, ...]:
    """Variances of every sensor by the innovations of one solve: ``R_new = R * mean(r^2) / mean(M)``, component by component.

    This is a step of variance-component estimation (Helmert, Foerstner). Limits: it takes the other covariances to be right,
    so that solving and
    proposing again until it settles is needed when several are off, and then only their redundant parts can be told apart; model error
    (masses, centres, soft tissue) goes into the sensor that notices it; bias counts as variance; a component that nobody else
    checks gets none.

    Parameters
    ----------
    problem : HumanDynamics
    estimate : HumanDynamicsEstimate
        Of that problem, with covariance.
    """
    out: list[CovarianceProposal] = []
    for sensor, found in zip(problem.sensors, estimate.innovations, strict=True):
        C = sensor.variances()
        diagonal = (
            C
            if C.ndim == 1
            else (np.diagonal(C, axis1=-2, axis2=-1) if problem.system.sensors[len(out)].full else C)
        )
        current = diagonal if diagonal.ndim == 1 else np.mean(diagonal, axis=0)
        share = found.redundancy
        square = np.nanmean(np.where(np.isnan(found.residual), np.nan, found.residual**2), axis=0)
        checked = share > 1e-3
        proposed = np.where(checked, square / np.where(checked, share, 1.0), np.nan)
        samples = _independent(found.residual)
        sd = np.where(checked, np.sqrt(2.0 / max(samples, 1.0)) / np.sqrt(np.clip(share, 1e-3, 1.0)), np.nan)
        unseen = int(np.count_nonzero(~checked))
        words = f"{unseen} of {checked.size} components are checked by nothing else" if unseen else ""
        if samples < 30.0:
            words += ("; " if words else "") + f"only about {samples:.0f} independent samples"
        bias = np.nanmean(found.residual, axis=0) ** 2 / np.where(square > 0.0, square, 1.0)
        if np.any(bias[checked] > 0.5):
            words += (
                "; " if words else ""
            ) + "most of it is a constant error, which a variance does not describe"
        out.append(CovarianceProposal(found.name, current, proposed, samples, sd, words))
    return tuple(out)


def _independent(residual: FloatArray) -> float:
    """Number of independent samples, from the lag-one correlation of the residuals."""
    good = residual[np.all(np.isfinite(residual), axis=1)]
    if good.shape[0] < 4:
        return float(good.shape[0])
    centred = good - good.mean(axis=0)
    power = np.sum(centred**2, axis=0)
    rho = float(
        np.clip(
            np.mean(np.sum(centred[1:] * centred[:-1], axis=0) / np.where(power > 0.0, power, 1.0)),
            0.0,
            0.9999,
        )
    )
    return float(good.shape[0] * (1.0 - rho) / (1.0 + rho))
