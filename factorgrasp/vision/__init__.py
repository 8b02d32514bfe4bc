"""Markers on a hand in RGB and RGB-D images: the reference colour, the detector, frames, and recordings of blobs.

Needs OpenCV: ``pip install 'factorgrasp[vision]'``.
"""

from __future__ import annotations

from factorgrasp.vision.blobs import DetectedBlobs
from factorgrasp.vision.colour import ColourReference, learn_colour, read_colour
from factorgrasp.vision.detector import BlobDetector
from factorgrasp.vision.frames import Frame, FrameSource, read_frames
from factorgrasp.vision.propose import propose_colour
from factorgrasp.vision.recording import detect_recording, propose_detector
from factorgrasp.vision.settings import DetectorSettings

__all__ = [
    "BlobDetector",
    "ColourReference",
    "DetectedBlobs",
    "DetectorSettings",
    "Frame",
    "FrameSource",
    "detect_recording",
    "learn_colour",
    "propose_colour",
    "propose_detector",
    "read_colour",
    "read_frames",
]
