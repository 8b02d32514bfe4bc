"""How much every part of the human-dynamics problem is trusted: variances a link or joint and a component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray

PerName = float | Sequence[float] | FloatArray | Mapping[str, float | Sequence[float] | FloatArray]
"""Variances: one for all, one a component, or either by the name of a link or joint, with "default" for those not named."""


@dataclass(frozen=True)
class HumanDynamicsNoise:
    """Variances of the model, the pseudo-measurements and the prior.

    Attributes
    ----------
    propagation : PerName
        ``Sigma_D`` of the accelerations' propagation by joint, six components ``[linear; angular]``, (m/s^2)^2 and (rad/s^2)^2.
    balance : PerName
        ``Sigma_D`` of Newton-Euler by link, ``[force; moment]``, N^2 and (Nm)^2.
    free_wrench : PerName
        Of the zero external wrench of links that touch nothing, by link, N^2 and (Nm)^2.
    contact_wrench : PerName
        Of the zero that stands for an unmeasured wrench, by link of a contact: loose, N^2 and (Nm)^2.
    joint_acceleration : PerName
        Of the motion's own joint accelerations, by joint, (rad/s^2)^2.
    link_acceleration : PerName
        Of the motion's own link accelerations, by link, (m/s^2)^2 and (rad/s^2)^2.
    prior_link_acceleration, prior_external_wrench, prior_joint_wrench, prior_joint_acceleration : PerName
        ``Sigma_d`` by link or joint. The mean is zero.
    """

    propagation: PerName = 1e-4
    balance: PerName = 1e-4
    free_wrench: PerName = 1e-4
    contact_wrench: PerName = (1e4, 1e4, 1e4, 1e2, 1e2, 1e2)
    joint_acceleration: PerName = 1e-3
    link_acceleration: PerName = 1e-3
    prior_link_acceleration: PerName = 1e6
    prior_external_wrench: PerName = 1e6
    prior_joint_wrench: PerName = 1e6
    prior_joint_acceleration: PerName = 1e6

    @classmethod
    def latella2018(cls, model: float = 1e-4) -> HumanDynamicsNoise:
        """Latella 2018 and its data set: model 1e-4 (1e-1 where it is known to be wrong), prior 1e4, joint accelerations 6.66e-6."""
        return cls(
            propagation=model, balance=model, joint_acceleration=6.66e-6, free_wrench=1e-6, prior_link_acceleration=1e4,
            prior_external_wrench=1e4, prior_joint_wrench=1e4, prior_joint_acceleration=1e4,
        )  # fmt: skip

    @classmethod
    def tirupachuri2021(cls) -> HumanDynamicsNoise:
        """Tirupachuri 2021, table 1: model 1e-6, feet and free links 1e-6, hand force 1 and moment 1e-4, prior 1e6."""
        return cls(
            propagation=1e-6, balance=1e-6, free_wrench=1e-6, contact_wrench=(1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4)
        )


def resolve(value: PerName, names: Sequence[str], sizes: Sequence[int], field: str) -> list[FloatArray]:
    """Variances (size,) for every name.

    Raises
    ------
    InputError
        Naming the field and the entry for a shape that does not fit, a variance that is not positive, or an unknown name.
    """
    if isinstance(value, Mapping):
        unknown = sorted(set(value) - set(names) - {"default"})
        if unknown:
            raise InputError(field, "names among " + ", ".join(names) + " or 'default'", ", ".join(unknown))
        if "default" not in value and set(value) != set(names):
            raise InputError(
                field,
                "all names or a 'default'",
                "nothing for " + ", ".join(n for n in names if n not in value),
            )
        chosen = [value[name] if name in value else value["default"] for name in names]
    else:
        chosen = [value] * len(names)
    out = []
    for name, size, one in zip(names, sizes, chosen, strict=True):
        array = np.asarray(one, dtype=float)
        if array.ndim > 1 or (array.ndim == 1 and array.size != size):
            raise InputError(f"{field} of {name}", f"a variance or {size} of them", f"shape {array.shape}")
        if not np.all(np.isfinite(array)) or np.any(array <= 0.0):
            raise InputError(f"{field} of {name}", "finite variances above zero", f"{array}")
        out.append(np.broadcast_to(array, (size,)).astype(float))
    return out
