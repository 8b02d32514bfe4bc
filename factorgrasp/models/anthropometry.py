"""Published proportions of the human body: what the body model is made of, every number with its source.

- [deLeva] P. de Leva, *Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters*, J. Biomechanics 29(9), 1996, table 4
  (61.9 kg and 1.735 m for women, 73.0 kg and 1.741 m for men).
- [Winter] D. A. Winter, *Biomechanics and Motor Control of Human Movement*, 4th ed., 2009: fig. 4.1 (lengths as fractions of the stature,
  after Drillis and Contini 1964) and table 4.1 (densities).
- [Dumas] R. Dumas, L. Cheze, J.-P. Verriest, *Adjustments to McConville et al. and Young et al. body segment inertial parameters*,
  J. Biomechanics 40(3), 2007.
- [Gray] *Gray's Anatomy*: lengths of the parts of the vertebral column.
- [ANSUR] C. C. Gordon et al., *1988 Anthropometric Survey of U.S. Army Personnel*, 1989.
- [Harrington] M. E. Harrington et al., *Prediction of the hip joint centre in adults ...*, J. Biomechanics 40(3), 2007.
- [Xsens-like] mass fractions of the 23-segment model of C. Latella et al., Autonomous Robots 43, 2019 (sec. 3, after Winter 2009 and
  Herman 2007), only where [deLeva] has one segment and the model two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

Sex: TypeAlias = Literal["female", "male"]


@dataclass(frozen=True)
class SegmentRow:
    """One row of [deLeva] table 4.

    Attributes
    ----------
    length : float
        Between the endpoints, m, of the reference stature.
    mass : float
        Fraction of the body's mass.
    com : float
        Distance of the centre of mass from the proximal (of head and trunk: the upper) endpoint, fraction of the length.
    sagittal, transverse, longitudinal : float
        Radii of gyration about the anteroposterior, the mediolateral and the long axis, fractions of the length.
    """

    length: float
    mass: float
    com: float
    sagittal: float
    transverse: float
    longitudinal: float


REFERENCE_STATURE: Mapping[Sex, float] = {"female": 1.735, "male": 1.741}
"""m, [deLeva]."""

DE_LEVA: Mapping[Sex, Mapping[str, SegmentRow]] = {
    "female": {
        "head": SegmentRow(
            0.2437, 0.0668, 0.4841, 0.271, 0.295, 0.261
        ),  # vertex to cervicale (C7), neck included
        "upper_trunk": SegmentRow(0.2280, 0.1545, 0.5050, 0.466, 0.314, 0.449),  # cervicale to xiphion
        "middle_trunk": SegmentRow(0.2053, 0.1465, 0.4512, 0.433, 0.354, 0.415),  # xiphion to omphalion
        "lower_trunk": SegmentRow(0.1815, 0.1247, 0.4920, 0.433, 0.402, 0.444),  # omphalion to mid-hip
        "upper_arm": SegmentRow(0.2751, 0.0255, 0.5754, 0.278, 0.260, 0.148),  # shoulder to elbow
        "forearm": SegmentRow(0.2643, 0.0138, 0.4559, 0.261, 0.257, 0.094),  # elbow to wrist
        "hand": SegmentRow(0.1701, 0.0056, 0.3427, 0.244, 0.208, 0.154),  # wrist to third fingertip
        "thigh": SegmentRow(0.3685, 0.1478, 0.3612, 0.369, 0.364, 0.162),  # hip to knee
        "shank": SegmentRow(0.4386, 0.0481, 0.4352, 0.267, 0.263, 0.092),  # knee to ankle
        "foot": SegmentRow(0.2283, 0.0129, 0.4014, 0.299, 0.279, 0.139),  # heel to toe tip
    },
    "male": {
        "head": SegmentRow(0.2429, 0.0694, 0.5002, 0.303, 0.315, 0.261),
        "upper_trunk": SegmentRow(0.2421, 0.1596, 0.5066, 0.505, 0.320, 0.465),
        "middle_trunk": SegmentRow(0.2155, 0.1633, 0.4502, 0.482, 0.383, 0.468),
        "lower_trunk": SegmentRow(0.1457, 0.1117, 0.6115, 0.615, 0.551, 0.587),
        "upper_arm": SegmentRow(0.2817, 0.0271, 0.5772, 0.285, 0.269, 0.158),
        "forearm": SegmentRow(0.2689, 0.0162, 0.4574, 0.276, 0.265, 0.121),
        "hand": SegmentRow(0.1879, 0.0061, 0.3624, 0.288, 0.235, 0.184),
        "thigh": SegmentRow(0.4222, 0.1416, 0.4095, 0.329, 0.329, 0.149),
        "shank": SegmentRow(0.4403, 0.0433, 0.4395, 0.251, 0.246, 0.102),
        "foot": SegmentRow(0.2581, 0.0137, 0.4415, 0.257, 0.245, 0.124),
    },
}
"""[deLeva] table 4; limbs stand for one side. The female and the male column sum to 0.9999 and 1.0000 of the body's mass."""

MID_SHOULDER_HEIGHT: Mapping[Sex, float] = {"female": 0.4979, "male": 0.5155}
"""Shoulder joint centres over mid-hip, m, [deLeva] (MIDS to MIDH)."""
SUPRASTERNALE_HEIGHT: Mapping[Sex, float] = {"female": 0.5293, "male": 0.5319}
"""Suprasternale over mid-hip, m, [deLeva] (SUPR to MIDH): the height of the sternoclavicular joints."""

LUMBAR_JOINT_HEIGHT: Mapping[Sex, float] = {"female": 0.107 / 1.61, "male": 0.094 / 1.77}
"""L5/S1 over the hip joint centres, fraction of the stature, [Dumas]."""
LUMBAR_SHARE = 18.0 / (18.0 + 28.0)
"""Share of the lumbar spine in the length from L5/S1 to C7/T1, [Gray]; its 5 and the 12 thoracic vertebrae count as equally high each."""

NECK_LENGTH = 0.052
"""C7/T1 to the joint of the head, fraction of the stature: chin (0.870) minus shoulder height (0.818), [Winter]."""
ANKLE_HEIGHT = 0.039
"""Fraction of the stature, [Winter]."""
FOOT_BREADTH = 0.055
"""Fraction of the stature, [Winter]."""
HEEL_TO_ANKLE = 0.25
"""Fraction of the foot's length. An assumption: none of the tables has it; it moves the foot's 1.4 % of mass by centimetres."""
BALL_OF_FOOT = 0.73
"""Heel to metatarsophalangeal joints, fraction of the foot's length, [ANSUR]."""

HALF_BIACROMIAL: Mapping[Sex, float] = {"female": 0.1114, "male": 0.1130}
"""Mid-plane to shoulder joint, fraction of the stature: half the biacromial breadth (363 of 1629 mm, 397 of 1756 mm), [ANSUR]."""
STERNOCLAVICULAR_OFFSET = 0.0145
"""Mid-plane to the joint of the shoulder girdle, fraction of the stature: 25 mm. An assumption."""
HALF_HIP_SPACING = (0.33 * 0.240 + 0.0073) / 1.741
"""Mid-plane to hip joint, fraction of the stature: 0.33 PW + 7.3 mm for a pelvis 240 mm wide at 1.741 m, [Harrington]."""

SHOULDER_MASS = 0.031
"""One shoulder girdle, fraction of the body's mass, taken out of the upper trunk, [Xsens-like]."""
NECK_SHARE = 0.012 / (0.012 + 0.036)
"""Of the mass of head and neck, [Xsens-like]."""
TOE_SHARE = 0.0015 / (0.0130 + 0.0015)
"""Of the mass of foot and toes, [Xsens-like]."""

NECK_DENSITY = 1110.0
"""kg/m^3, head and neck, [Winter] table 4.1."""
SHOULDER_DENSITY = 1040.0
"""kg/m^3, shoulder, [Winter] table 4.1."""
FOOT_DENSITY = 1100.0
"""kg/m^3, foot, [Winter] table 4.1."""

STATURES = (1.2, 2.3)
"""m: outside of them the proportions of adults, which all these tables have, mean nothing."""
MASSES = (30.0, 250.0)
"""kg: likewise."""
