"""Streaming estimators: the terms of the problems, one frame at a time, in bounded memory and time.

Names load when first used, so that one estimator does not pay for the others.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgrasp.online.change import DetectorSettings
    from factorgrasp.online.estimate import OnlineGraspEstimate, StreamCounts
    from factorgrasp.online.events import GraspEvent
    from factorgrasp.online.grasp import OnlineGraspPose
    from factorgrasp.online.wrist import OnlineWristPose

_WHERE = {
    "DetectorSettings": "change",
    "GraspEvent": "events",
    "OnlineGraspEstimate": "estimate",
    "OnlineGraspPose": "grasp",
    "OnlineWristPose": "wrist",
    "StreamCounts": "estimate",
}

__all__ = [
    "DetectorSettings",
    "GraspEvent",
    "OnlineGraspEstimate",
    "OnlineGraspPose",
    "OnlineWristPose",
    "StreamCounts",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
