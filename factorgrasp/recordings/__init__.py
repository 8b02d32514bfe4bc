"""Recordings: plain dataclasses, and one reader (and writer) for each file format."""

from factorgrasp.recordings.blobs import BlobFrame, BlobRecording, read_blobs, write_blobs
from factorgrasp.recordings.csv import (
    read_imu,
    read_joints,
    read_motion,
    read_poses,
    read_stream,
    write_csv,
)
from factorgrasp.recordings.forces import (
    ForceRecording,
    read_external_loads,
    read_force,
    read_force_table,
    read_opensim_forces,
    read_wrench_table,
)
from factorgrasp.recordings.links import read_link_coordinates, read_link_forces
from factorgrasp.recordings.opensim import (
    CoordinateTable,
    MarkerRecording,
    StorageTable,
    read_coordinates,
    read_storage,
    read_trc,
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
    "BlobFrame",
    "BlobRecording",
    "CoordinateTable",
    "ForceRecording",
    "Gaps",
    "ImuStream",
    "JointStream",
    "MarkerRecording",
    "MotionStream",
    "PoseStream",
    "StorageTable",
    "column_names",
    "read_blobs",
    "read_coordinates",
    "read_external_loads",
    "read_force",
    "read_force_table",
    "read_imu",
    "read_joints",
    "read_link_coordinates",
    "read_link_forces",
    "read_motion",
    "read_opensim_forces",
    "read_poses",
    "read_storage",
    "read_stream",
    "read_table",
    "read_trc",
    "read_wrench_table",
    "write_blobs",
    "write_csv",
]
