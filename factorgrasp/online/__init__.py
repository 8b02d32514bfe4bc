"""Streaming estimators: the same terms as the batch problems, bounded memory and latency."""

from __future__ import annotations

from factorgrasp.online.change_watch import DetectorSettings
from factorgrasp.online.estimate import OnlineGraspEstimate, StreamCounts
from factorgrasp.online.events import GraspEvent
from factorgrasp.online.grasp import OnlineGraspPose

__all__ = ["DetectorSettings", "GraspEvent", "OnlineGraspEstimate", "OnlineGraspPose", "StreamCounts"]
