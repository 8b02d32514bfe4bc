"""The human-dynamics estimate in a few lines."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from factorgrasp.problems.human_dynamics_estimate import HumanDynamicsEstimate
    from factorgrasp.problems.human_dynamics_innovations import Innovation

WIDE = 2.0
"""Ratio of NIS to its degrees of freedom from which a covariance is said not to fit (and below one over it)."""


def summarize(estimate: HumanDynamicsEstimate) -> str:
    """Torques, joint moments, agreement of the sensors, and constraints that are active."""
    good = np.array([status.ok for status in estimate.status])
    lines = [
        f"human dynamics: {int(good.sum())} of {len(estimate)} frames solved by {estimate.solver} in {estimate.time:.3g} s"
    ]
    for frame, words in list(estimate.messages.items())[:3]:
        lines.append(f"  frame {frame}: {words}")
    if not good.any():
        return "\n".join(lines)
    if estimate.dof_names:
        lines.append("torque, Nm: largest magnitude, median sd")
        peak = np.nanmax(np.abs(estimate.torque[good]), axis=0)
        for name, value, sd in zip(
            estimate.dof_names, peak, np.median(estimate.torque_sd[good], axis=0), strict=True
        ):
            lines.append(f"  {name:32s} {value:10.2f} {sd:10.3g}")
    for j, name in enumerate(estimate.joint_names):
        if not any(dof.startswith(name) for dof in estimate.dof_names):
            moment = np.linalg.norm(estimate.joint_moment[good, j], axis=1)
            lines.append(
                f"  moment of {name:22s} {moment.max():10.2f} {np.median(estimate.joint_moment_sd[good, j]):10.3g}"
            )
    lines += [agreement_words(found) for found in estimate.innovations]
    for (_, meaning), count in Counter((a.name, a.meaning) for a in estimate.active).most_common(8):
        lines.append(f"active in {count} frames: {meaning}")
    return "\n".join(lines)


def agreement_words(found: Innovation) -> str:
    """Whether a sensor's covariance fits what the others say."""
    ratio = found.ratio
    if not np.isfinite(ratio):
        return f"{found.name}: nothing else can check it"
    verdict = "its covariance fits"
    if ratio > WIDE:
        times = f"{np.sqrt(ratio):.1f} times as large as its covariance and theirs say"
        verdict = f"disagrees with the model and the other sensors: errors {times}"
    elif ratio < 1.0 / WIDE:
        verdict = f"agrees better than its covariance says: errors {np.sqrt(ratio):.2f} times as large"
    return f"{found.name}: NIS per degree of freedom {ratio:.3g}; {verdict}"
