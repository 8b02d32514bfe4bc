"""Is a link-level motion one of a physical body? Checks that name the link or joint that is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgrasp.errors import InputError
from factorgrasp.typing import FloatArray, IntArray

# An inertia from rounded tables may miss the triangle inequality by this share of its largest moment.
TRIANGLE_SLACK = 1e-3


def check_names(names: Sequence[str], what: str) -> None:
    """Raise InputError unless every name is a non-empty string and none repeats."""
    for place, name in enumerate(names):
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{what}[{place}]", "a name", repr(name))
    repeated = sorted({name for name in names if list(names).count(name) > 1})
    if repeated:
        raise InputError(
            f"{what}", "unique names", ", ".join(repr(name) for name in repeated) + " more than once"
        )


def check_masses(links: Sequence[str], mass: FloatArray, com: FloatArray, inertia: FloatArray) -> None:
    """Raise InputError for a mass, centre of mass or inertia that no body can have."""
    for i, link in enumerate(links):
        if not np.isfinite(mass[i]) or mass[i] < 0.0:
            raise InputError(f"mass of {link}", "a finite mass of at least 0 kg", f"{mass[i]:.6g} kg")
        if not np.all(np.isfinite(com[i])):
            raise InputError(f"centre of mass of {link}", "finite coordinates in m", f"{com[i]}")
        moment = inertia[i]
        if not np.all(np.isfinite(moment)):
            raise InputError(f"inertia of {link}", "finite numbers in kg m^2", "NaN or infinity")
        scale = float(np.abs(moment).max())
        if not np.allclose(moment, moment.T, rtol=0.0, atol=1e-9 * scale):
            raise InputError(f"inertia of {link}", "a symmetric matrix", f"{moment.tolist()}")
        moments = np.linalg.eigvalsh(moment)
        if moments[0] < -1e-9 * scale:
            raise InputError(
                f"inertia of {link}",
                "a positive semidefinite matrix in kg m^2",
                f"principal moments {moments}",
            )
        if moments[0] + moments[1] < (1.0 - TRIANGLE_SLACK) * moments[2]:
            raise InputError(
                f"inertia of {link}",
                "principal moments each at most the sum of the other two",
                f"{moments}",
                "It is to be given about the centre of mass, in the link's axes",
            )
        if mass[i] == 0.0 and scale > 0.0:
            raise InputError(f"mass of {link}", "a mass above 0 kg, as it has an inertia", "0 kg")


def check_rotations(R: FloatArray, links: Sequence[str]) -> None:
    """Raise InputError where an orientation is neither NaN (a gap) nor a rotation matrix."""
    error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    bad = (error > 1e-3) | (np.linalg.det(R) < 0.0)
    if bad.any():
        frame, link = (int(v[0]) for v in np.nonzero(bad))
        raise InputError(
            f"orientation of {links[link]}",
            "rotation matrices R_w_l (link to world)",
            f"R'R off by {error[frame, link]:.2g}, determinant {np.linalg.det(R[frame, link]):.3g} in frame {frame}",
        )


def check_tree(links: Sequence[str], joints: Sequence[str], parents: IntArray, children: IntArray) -> int:
    """Index of the one root of the tree; InputError when the joints do not make a tree over the links."""
    seen: dict[int, str] = {}
    for name, parent, child in zip(joints, parents, children, strict=True):
        for end, index in (("parent", int(parent)), ("child", int(child))):
            if not 0 <= index < len(links):
                raise InputError(
                    f"{end} of joint {name}", f"the index of one of {len(links)} links", str(index)
                )
        if int(child) in seen:
            raise InputError(
                f"joint {name}",
                "one joint to a parent for every link",
                f"{links[int(child)]} is also the child of {seen[int(child)]}",
            )
        seen[int(child)] = name
    roots = [i for i in range(len(links)) if i not in seen]
    if len(roots) != 1:
        found = ", ".join(links[i] for i in roots) or "none (a closed loop)"
        raise InputError("joints", "a tree with one root link", f"links without a parent: {found}")
    above = {int(c): int(p) for p, c in zip(parents, children, strict=True)}
    for start in above:
        link, steps = start, 0
        while link in above:
            link, steps = above[link], steps + 1
            if steps > len(links):
                raise InputError("joints", "a tree", f"a closed loop through {links[start]}")
    return roots[0]
