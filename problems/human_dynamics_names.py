"""Names of the unknowns of the human-dynamics problem."""

from __future__ import annotations


def acceleration_of(link: str) -> str:
    """A link's proper acceleration."""
    return f"acceleration of {link}"


def wrench_on(link: str) -> str:
    """A link's net external wrench."""
    return f"external wrench on {link}"


def wrench_of(joint: str) -> str:
    """A joint's wrench, parent on child."""
    return f"wrench of {joint}"


def joint_acceleration_of(joint: str) -> str:
    """A joint's accelerations."""
    return f"joint acceleration of {joint}"


def pose_error_of(name: str) -> str:
    """Error of a joint's position, or of the root's pose, true less measured."""
    return f"pose error of {name}"
