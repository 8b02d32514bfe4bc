"""The URDF of a human body: every ball joint as three hinges with links without mass between them."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from factorgrasp.models.human import JOINTS, LINKS, joint_of
from factorgrasp.models.solids import Solid
from factorgrasp.typing import FloatArray

if TYPE_CHECKING:
    from factorgrasp.models.human import HumanBody

_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def urdf_text(body: HumanBody) -> str:
    """The URDF of a body; numbers have all their digits, so that reading it gives the same body."""
    lines = ['<?xml version="1.0" encoding="utf-8"?>', '<robot name="human">']
    for link in LINKS:
        if link != "Pelvis":
            lines += _ball_joint(body, link)
        lines += _link(link, body.segments[link], body.ends[link])
    lines.append("</robot>")
    return "\n".join(lines) + "\n"


def _ball_joint(body: HumanBody, link: str) -> list[str]:
    name = joint_of(link)
    parent, origin = JOINTS[name][0], body.placements[name]
    lines = []
    for axis in "xyz":
        child = link if axis == "z" else f"{link}_{axis}"
        if axis != "z":
            lines.append(f"  <link name={quoteattr(child)}/>")
        lines += [
            f'  <joint name="{name}_{axis}" type="revolute">',
            f'    <origin xyz="{_numbers(origin)}" rpy="0 0 0"/>',
            f"    <parent link={quoteattr(parent)}/>",
            f"    <child link={quoteattr(child)}/>",
            f'    <axis xyz="{_AXES[axis]}"/>',
            '    <limit lower="-3.141592653589793" upper="3.141592653589793" effort="1000" velocity="100"/>',
            "  </joint>",
        ]
        parent, origin = child, np.zeros(3)
    return lines


def _link(name: str, solid: Solid, end: FloatArray) -> list[str]:
    inertia = solid.inertia
    entries = " ".join(
        f'i{"xyz"[r]}{"xyz"[c]}="{float(inertia[r, c])!r}"' for r in range(3) for c in range(r, 3)
    )
    return [
        f"  <link name={quoteattr(name)}>",
        "    <inertial>",
        f'      <origin xyz="{_numbers(solid.com)}" rpy="0 0 0"/>',
        f'      <mass value="{float(solid.mass)!r}"/>',
        f"      <inertia {entries}/>",
        "    </inertial>",
        *_shape(name, solid, end),
        "  </link>",
    ]


def _shape(name: str, solid: Solid, end: FloatArray) -> list[str]:
    """A box along the segment with the volume of its mass in water; a sphere for the head."""
    length = float(np.linalg.norm(end))
    volume = solid.mass / 1000.0
    if name == "Head":
        radius = (0.75 * volume / np.pi) ** (1.0 / 3.0)
        centre, geometry = solid.com, f'<sphere radius="{radius:.5g}"/>'
    else:
        size = np.where(np.abs(end) > 0.5 * length, length, np.sqrt(volume / length))
        centre, geometry = 0.5 * end, f'<box size="{" ".join(f"{s:.5g}" for s in size)}"/>'
    return [
        "    <visual>",
        f'      <origin xyz="{" ".join(f"{c:.5g}" for c in centre)}" rpy="0 0 0"/>',
        f"      <geometry>{geometry}</geometry>",
        "    </visual>",
    ]


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)
