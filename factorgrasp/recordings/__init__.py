"""Recordings: plain dataclasses, and one reader (and writer) for each file format."""

from factorgrasp.recordings.csv import (
    read_imu,
    read_joints,
    read_motion,
    read_poses,
    read_stream,
    write_csv,
)
from factorgrasp.recordings.streams import (
    Gaps,
    ImuStream,
    JointStream,
    MotionStream,
    PoseStream,
)
from factorgrasp.recordings.tables import column_names, read_table

__all__ = [
    "Gaps",
    "ImuStream",
    "JointStream",
    "MotionStream",
    "PoseStream",
    "column_names",
    "read_imu",
    "read_joints",
    "read_motion",
    "read_poses",
    "read_stream",
    "read_table",
    "write_csv",
]
