"""A human body of 23 rigid segments and 22 ball joints (66 degrees of freedom) from height, mass and sex (mathematics 4.6).

Segments and joints have the names of the Xsens MVN body model. In the zero configuration the body stands in a T-pose: x forward, y to
the left, z up, all frames parallel to the world's, each at the joint to its parent, the pelvis' in the middle between the hip joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from factorgrasp.errors import InputError
from factorgrasp.models import anthropometry as tables
from factorgrasp.models.anthropometry import Sex
from factorgrasp.models.solids import Column, Solid, box, gyration, join, remove, rod
from factorgrasp.models.urdf_check import check_urdf
from factorgrasp.typing import FloatArray

JointKind = Literal["revolute", "spherical"]

LINKS = (
    "Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head",
    "RightShoulder", "RightUpperArm", "RightForeArm", "RightHand",
    "LeftShoulder", "LeftUpperArm", "LeftForeArm", "LeftHand",
    "RightUpperLeg", "RightLowerLeg", "RightFoot", "RightToe",
    "LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToe",
)  # fmt: skip
JOINTS: Mapping[str, tuple[str, str]] = {
    "jL5S1": ("Pelvis", "L5"),
    "jL4L3": ("L5", "L3"),
    "jL1T12": ("L3", "T12"),
    "jT9T8": ("T12", "T8"),
    "jT1C7": ("T8", "Neck"),
    "jC1Head": ("Neck", "Head"),
    **{
        f"j{side}{joint}": (parent.format(side), f"{side}{child}")
        for side in ("Right", "Left")
        for joint, parent, child in (
            ("C7Shoulder", "T8", "Shoulder"),
            ("Shoulder", "{}Shoulder", "UpperArm"),
            ("Elbow", "{}UpperArm", "ForeArm"),
            ("Wrist", "{}ForeArm", "Hand"),
            ("Hip", "Pelvis", "UpperLeg"),
            ("Knee", "{}UpperLeg", "LowerLeg"),
            ("Ankle", "{}LowerLeg", "Foot"),
            ("BallFoot", "{}Foot", "Toe"),
        )
    },
}
"""Joint to (parent, child)."""


@dataclass(frozen=True, eq=False)
class HumanBody:
    """A body of rigid segments with ball joints; make one with :func:`human_body`.

    Attributes
    ----------
    height, mass : float
        m and kg, of the person; `mass` is that of all segments, loads included.
    sex : {"female", "male"}
    segments : dict of str to Solid
        Mass, centre of mass and inertia in the segment's own frame.
    placements : dict of str to (3,) ndarray
        Joint to its position in the parent's frame, m.
    ends : dict of str to (3,) ndarray
        Segment to its far end in its own frame, m (next joint, vertex, fingertip, toe tip): for drawings and for where a hand holds.
    """

    height: float
    mass: float
    sex: Sex
    segments: Mapping[str, Solid]
    placements: Mapping[str, FloatArray]
    ends: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_segments(self.segments, self.mass)

    @property
    def sole(self) -> Mapping[str, FloatArray]:
        """Link (feet and toes) to the four corners (4, 3) of its part of the sole in its own frame, m."""
        out = {}
        breadth = 0.5 * tables.FOOT_BREADTH * self.height
        for side in ("Right", "Left"):
            ball = self.placements[f"j{side}BallFoot"]
            depth = -tables.ANKLE_HEIGHT * self.height
            heel = ball[0] - tables.BALL_OF_FOOT * self.foot_length
            spans = {
                "Foot": (heel, float(ball[0]), depth),
                "Toe": (0.0, float(self.ends[f"{side}Toe"][0]), depth - ball[2]),
            }
            for name, (back, front, z) in spans.items():
                corners = [(x, y, z) for x in (back, front) for y in (-breadth, breadth)]
                out[f"{side}{name}"] = np.array(corners, dtype=np.float64)
        return out

    @property
    def markers(self) -> Mapping[str, tuple[str, FloatArray]]:
        """Name to (link, position in its frame, m): four points on the skin of every segment.

        A marker set for simulations and for suits whose markers follow it; names are the segment's with ``_1`` to ``_4`` behind.
        """
        out: dict[str, tuple[str, FloatArray]] = {}
        for link, solid in self.segments.items():
            end = self.ends[link]
            length = float(np.linalg.norm(end))
            along = end / length
            # Half of the thickness of a bar of that mass and length with the density of water.
            radius = max(0.5 * float(np.sqrt(solid.mass / (1000.0 * length))), 0.02)
            side = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 1.0, 0.0])
            side /= np.linalg.norm(side)
            front = np.cross(side, along)
            for k, (share, x, y) in enumerate(
                ((0.15, 1.0, 0.0), (0.4, -0.6, 0.8), (0.65, -0.6, -0.8), (0.9, 0.8, 0.6)), start=1
            ):
                out[f"{link}_{k}"] = (link, share * end + radius * (x * side + y * front))
        return out

    @property
    def foot_length(self) -> float:
        """Heel to toe tip, m."""
        scale = self.height / tables.REFERENCE_STATURE[self.sex]
        return tables.DE_LEVA[self.sex]["foot"].length * scale

    def with_load(self, link: str, mass: float, point: ArrayLike = (0.0, 0.0, 0.0)) -> HumanBody:
        """The body with a point mass fixed to a segment.

        Parameters
        ----------
        link : str
        mass : float
            kg, above zero.
        point : (3,) array_like
            In the segment's frame, m.
        """
        if link not in self.segments:
            raise InputError("link of the load", "one of " + ", ".join(self.segments), repr(link))
        if not (np.isfinite(mass) and mass > 0.0):
            raise InputError(f"mass of the load on {link}", "above 0 kg", f"{mass} kg")
        load = Solid(mass, np.asarray(point, dtype=float), np.zeros((3, 3)))
        segments = {**self.segments, link: join([self.segments[link], load])}
        return replace(self, mass=self.mass + mass, segments=segments)

    def model(self, joints: JointKind = "revolute", floating: bool = True) -> Any:
        """``pinocchio.Model`` of the body.

        Parameters
        ----------
        joints : {"revolute", "spherical"}
            "revolute": every ball joint as three hinges about x, y and z (in this order from the parent), named ``jRightKnee_x`` and so on,
            with links without mass between them, exactly as :meth:`urdf` writes them; singular where the middle angle is 90 degrees.
            "spherical": quaternions ``[x, y, z, w]``, singular nowhere.
        floating : bool
            A free-flyer under the pelvis (else the pelvis is fixed to the world).
        """
        import pinocchio as pin

        if joints not in ("revolute", "spherical"):
            raise InputError("joints", "'revolute' or 'spherical'", repr(joints))
        model = pin.Model()
        model.name = "human"
        here = pin.SE3.Identity()
        at = {"Pelvis": model.addJoint(0, pin.JointModelFreeFlyer(), here, "root_joint") if floating else 0}
        hinges = (("x", pin.JointModelRX()), ("y", pin.JointModelRY()), ("z", pin.JointModelRZ()))
        for link in _depth_first("Pelvis"):
            if link != "Pelvis":
                name = joint_of(link)
                index, where = at[JOINTS[name][0]], pin.SE3(np.eye(3), self.placements[name])
                if joints == "spherical":
                    index = model.addJoint(index, pin.JointModelSpherical(), where, name)
                else:
                    for axis, hinge in hinges:
                        index = model.addJoint(index, hinge, where, f"{name}_{axis}")
                        where = here
                at[link] = index
            solid = self.segments[link]
            model.appendBodyToJoint(at[link], pin.Inertia(solid.mass, solid.com, solid.inertia), here)
            model.addFrame(pin.Frame(link, at[link], here, pin.FrameType.BODY), False)
        model.gravity.linear = np.array([0.0, 0.0, -9.80665])
        return model

    def urdf(self) -> str:
        """The body as a URDF: 66 revolute joints, and a cylinder, box or sphere to look at for every segment."""
        from factorgrasp.models.human_urdf import urdf_text

        return urdf_text(self)

    def write_urdf(self, path: str | Path) -> Path:
        """Write :meth:`urdf` to a file, atomically; returns its path."""
        from factorgrasp.atomic import write_text

        return write_text(Path(path), self.urdf())


def joint_of(link: str) -> str:
    """Name of the joint above a segment."""
    for joint, (_, child) in JOINTS.items():
        if child == link:
            return joint
    raise InputError("link", "one with a joint to a parent", repr(link))


def human_body(height: float, mass: float, sex: Sex = "male") -> HumanBody:
    """A body with the proportions of published tables (:mod:`factorgrasp.models.anthropometry`).

    Parameters
    ----------
    height : float
        Stature, m.
    mass : float
        kg.
    sex : {"female", "male"}

    Raises
    ------
    InputError
        For a stature or mass outside of adults' (centimetres instead of metres, for instance).

    Notes
    -----
    Limbs are rows of de Leva's table. Where it has one segment and the body several, mass, centre of mass and inertia of all
    of them together stay those of the table:

    - trunk: de Leva's upper, middle and lower part are columns with a density linear in height (so that the centres of mass fit), cut at
      the heights of L5/S1 (Dumas), L4/L3, L1/T12, T9/T8 and C7/T1 (Gray's lumbar and thoracic lengths, equal vertebrae);
    - shoulder girdles: cylinders with 3.1 % of the mass each, taken out of the upper part;
    - neck: a cylinder with a quarter of the mass of head and neck, taken out of de Leva's head;
    - toes: a box with a tenth of the mass of the foot, taken out of de Leva's foot.

    Feet, shank, thigh, trunk and head on top of each other exceed de Leva's male stature by 2 %: these lengths are scaled so that they
    meet `height`. Spine, hips, knees, ankles and shoulders lie in one frontal plane.
    """
    _check_size(height, mass, sex)
    rows = tables.DE_LEVA[sex]
    total = sum(row.mass * (2 if name in _PAIRED else 1) for name, row in rows.items())
    upright = height * (1.0 - tables.ANKLE_HEIGHT)
    stack = upright / sum(rows[name].length for name in _STACK)
    along = {
        name: rows[name].length * (stack if name in _STACK else height / tables.REFERENCE_STATURE[sex])
        for name in rows
    }
    kg = {name: row.mass * mass / total for name, row in rows.items()}
    segments: dict[str, Solid] = {}
    placements: dict[str, FloatArray] = {}
    ends: dict[str, FloatArray] = {}
    _trunk_and_head(segments, placements, ends, height, mass, sex, stack, along, kg)
    for side, sign in (("Right", -1.0), ("Left", 1.0)):
        _arm(segments, placements, ends, side, sign, rows, along, kg)
        _leg(segments, placements, ends, side, sign, height, rows, along, kg)
    return HumanBody(height, mass, sex, {link: segments[link] for link in LINKS}, placements, ends)


def load_body(urdf: str | Path, floating: bool = True) -> Any:
    """``pinocchio.Model`` of a body's URDF, with a free-flyer under its root link unless `floating` is False.

    Raises
    ------
    InputError
        When the file is missing or is no URDF.
    """
    import pinocchio as pin

    path = Path(urdf)
    if not path.is_file():
        raise InputError("urdf", "an existing URDF file", str(path))
    check_urdf(path)
    try:
        return (
            pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
            if floating
            else pin.buildModelFromUrdf(str(path))
        )
    except (ValueError, RuntimeError) as error:
        raise InputError("urdf", "a URDF file that pinocchio reads", f"{path}: {error}") from error


def configuration(model: Any, angles: Mapping[str, ArrayLike], count: int | None = None) -> FloatArray:
    """Configurations with some of the joints set, by name; the others are zero (T-pose), the pelvis at the origin.

    Parameters
    ----------
    model : pinocchio.Model
        With hinges: ``HumanBody.model("revolute")`` or from a URDF.
    angles : mapping of str to float or (n,) array_like
        Joint, such as ``jRightKnee_y``, to its angle, rad.
    count : int, optional
        n when all angles are single numbers.

    Returns
    -------
    ndarray, shape (n, nq), or (nq,) when all angles are single numbers and `count` is None.
    """
    import pinocchio as pin

    values = {name: np.asarray(value, dtype=float) for name, value in angles.items()}
    shape = np.broadcast_shapes(
        *(value.shape for value in values.values()), () if count is None else (count,)
    )
    q = np.tile(pin.neutral(model), (*shape, 1)) if shape else np.asarray(pin.neutral(model))
    for name, value in values.items():
        if not model.existJointName(name) or model.joints[model.getJointId(name)].nq != 1:
            hinges = [str(n) for n, joint in zip(model.names, model.joints, strict=True) if joint.nq == 1]
            from factorgrasp.toml_tables import close_matches

            raise InputError("joint angle", "the name of a hinge", repr(name), close_matches(name, hinges))
        q[..., model.joints[model.getJointId(name)].idx_q] = value
    return np.asarray(q)


def check_segments(segments: Mapping[str, Solid], mass: float) -> None:
    """Raise InputError unless every segment is physical and all together weigh `mass` (kg)."""
    for link, solid in segments.items():
        if not (np.isfinite(solid.mass) and solid.mass > 0.0):
            raise InputError(f"mass of {link}", "above 0 kg", f"{solid.mass} kg")
        moments = np.linalg.eigvalsh(solid.inertia)
        if (
            not np.isfinite(moments).all()
            or moments[0] <= 0.0
            or moments[0] + moments[1] < (1.0 - 1e-9) * moments[2]
        ):
            raise InputError(
                f"inertia of {link}",
                "positive principal moments, each at most the sum of the other two",
                f"{moments} kg m^2",
            )
    total = sum(solid.mass for solid in segments.values())
    if abs(total - mass) > 1e-9 * mass:
        raise InputError("masses of the segments", f"{mass:.6g} kg in all", f"{total:.6g} kg")


_PAIRED = ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
_STACK = ("head", "upper_trunk", "middle_trunk", "lower_trunk", "thigh", "shank")


def _check_size(height: float, mass: float, sex: str) -> None:
    if sex not in tables.DE_LEVA:
        raise InputError("sex", "'female' or 'male': the tables have no other", repr(sex))
    low, high = tables.STATURES
    if not (np.isfinite(height) and low <= height <= high):
        hint = "Centimetres?" if 100.0 * low <= height <= 100.0 * high else ""
        raise InputError("height", f"{low} to {high} m", f"{height}", hint)
    low, high = tables.MASSES
    if not (np.isfinite(mass) and low <= mass <= high):
        raise InputError("mass", f"{low:.0f} to {high:.0f} kg", f"{mass}")


def _trunk_and_head(
    segments: dict[str, Solid],
    placements: dict[str, FloatArray],
    ends: dict[str, FloatArray],
    height: float,
    mass: float,
    sex: Sex,
    stack: float,
    along: Mapping[str, float],
    kg: Mapping[str, float],
) -> None:
    """Pelvis to head and both shoulder girdles; heights are over mid-hip."""
    rows = tables.DE_LEVA[sex]
    levels = np.cumsum([0.0, along["lower_trunk"], along["middle_trunk"], along["upper_trunk"]])
    columns = []
    for part, bottom, top in zip(
        ("lower_trunk", "middle_trunk", "upper_trunk"), levels, levels[1:], strict=False
    ):
        row, length = rows[part], float(top - bottom)
        sagittal, transverse, longitudinal = (
            (length * row.sagittal) ** 2,
            (length * row.transverse) ** 2,
            (length * row.longitudinal) ** 2,
        )
        columns.append(
            Column(
                float(bottom), float(top), kg[part], float(top) - row.com * length,
                0.5 * (longitudinal - sagittal + transverse), 0.5 * (longitudinal + sagittal - transverse),
            )
        )  # fmt: skip
    girdle = np.array(
        [0.0, tables.STERNOCLAVICULAR_OFFSET * height, tables.SUPRASTERNALE_HEIGHT[sex] * stack]
    )
    shoulder = np.array([0.0, tables.HALF_BIACROMIAL[sex] * height, tables.MID_SHOULDER_HEIGHT[sex] * stack])
    left = rod(tables.SHOULDER_MASS * mass, girdle, shoulder, tables.SHOULDER_DENSITY)
    columns[2] = _without_shoulders(columns[2], left)

    top = float(levels[-1])
    lumbar = tables.LUMBAR_JOINT_HEIGHT[sex] * height
    spine = top - lumbar
    t12 = lumbar + tables.LUMBAR_SHARE * spine
    heights = [0.0, lumbar, lumbar + 0.4 * (t12 - lumbar), t12, t12 + 4.0 / 12.0 * (top - t12), top]
    names = LINKS[:5]
    for link, low, high in zip(names, heights, heights[1:], strict=False):
        # Nothing of the trunk may get lost: its lowest part reaches down to mid-hip, its uppermost up to C7.
        pieces = [piece for column in columns if (piece := column.slice(low, high)) is not None]
        segments[link] = join(pieces).moved(np.array([0.0, 0.0, -low]))
        ends[link] = np.array([0.0, 0.0, high - low])
    for joint, low, high in zip(
        ("jL5S1", "jL4L3", "jL1T12", "jT9T8", "jT1C7"), heights, heights[1:], strict=False
    ):
        placements[joint] = np.array([0.0, 0.0, high - low])

    t8 = np.array([0.0, 0.0, heights[4]])
    for side, sign in (("Right", -1.0), ("Left", 1.0)):
        flip = np.array([1.0, sign, 1.0])
        one = left if sign > 0.0 else left.mirrored()
        placements[f"j{side}C7Shoulder"] = flip * girdle - t8
        placements[f"j{side}Shoulder"] = ends[f"{side}Shoulder"] = flip * (shoulder - girdle)
        segments[f"{side}Shoulder"] = one.moved(-flip * girdle)

    head = rows["head"]
    radii = along["head"] * np.array([head.sagittal, head.transverse, head.longitudinal])
    both = gyration(kg["head"], np.array([0.0, 0.0, (1.0 - head.com) * along["head"]]), radii)
    skull = np.array([0.0, 0.0, tables.NECK_LENGTH * height])
    neck = rod(tables.NECK_SHARE * kg["head"], np.zeros(3), skull, tables.NECK_DENSITY)
    segments["Neck"], placements["jC1Head"], ends["Neck"] = neck, skull, skull
    segments["Head"] = remove(both, neck).moved(-skull)
    ends["Head"] = np.array([0.0, 0.0, along["head"]]) - skull


def _without_shoulders(upper: Column, left: Solid) -> Column:
    """The upper trunk less both shoulder girdles: mass, centre of mass and spread to the sides of all three stay those of the table."""
    rest = upper.mass - 2.0 * left.mass
    com = (upper.mass * upper.com - 2.0 * left.mass * left.com[2]) / rest
    own = 0.5 * (left.inertia[0, 0] + left.inertia[2, 2] - left.inertia[1, 1]) / left.mass + left.com[1] ** 2
    spread = (upper.mass * upper.spread_y - 2.0 * left.mass * own) / rest
    return replace(upper, mass=rest, com=float(com), spread_y=float(spread))


def _arm(
    segments: dict[str, Solid],
    placements: dict[str, FloatArray],
    ends: dict[str, FloatArray],
    side: str,
    sign: float,
    rows: Mapping[str, tables.SegmentRow],
    along: Mapping[str, float],
    kg: Mapping[str, float],
) -> None:
    """Arm and hand, stretched out to the side: their long axis is y, and what is mediolateral in a hanging arm is upright."""
    links = (("UpperArm", "upper_arm", "Elbow"), ("ForeArm", "forearm", "Wrist"), ("Hand", "hand", ""))
    for link, name, next_joint in links:
        row, end = rows[name], np.array([0.0, sign * along[name], 0.0])
        radii = along[name] * np.array([row.sagittal, row.longitudinal, row.transverse])
        segments[f"{side}{link}"] = gyration(kg[name], row.com * end, radii)
        ends[f"{side}{link}"] = end
        if next_joint:
            placements[f"j{side}{next_joint}"] = end


def _leg(
    segments: dict[str, Solid],
    placements: dict[str, FloatArray],
    ends: dict[str, FloatArray],
    side: str,
    sign: float,
    height: float,
    rows: Mapping[str, tables.SegmentRow],
    along: Mapping[str, float],
    kg: Mapping[str, float],
) -> None:
    placements[f"j{side}Hip"] = np.array([0.0, sign * tables.HALF_HIP_SPACING * height, 0.0])
    for link, name, next_joint in (("UpperLeg", "thigh", "Knee"), ("LowerLeg", "shank", "Ankle")):
        row, end = rows[name], np.array([0.0, 0.0, -along[name]])
        radii = along[name] * np.array([row.sagittal, row.transverse, row.longitudinal])
        segments[f"{side}{link}"] = gyration(kg[name], row.com * end, radii)
        ends[f"{side}{link}"] = placements[f"j{side}{next_joint}"] = end
    row, length = rows["foot"], along["foot"]
    ankle = tables.ANKLE_HEIGHT * height
    heel, ball = -tables.HEEL_TO_ANKLE * length, (tables.BALL_OF_FOOT - tables.HEEL_TO_ANKLE) * length
    mass = tables.TOE_SHARE * kg["foot"]
    sizes = [(1.0 - tables.BALL_OF_FOOT) * length, tables.FOOT_BREADTH * height]
    thick = mass / (tables.FOOT_DENSITY * sizes[0] * sizes[1])
    # The whole foot lies level with its toes, as in the table, whose foot is a line from heel to toe tip; half of the mass of a
    # standing foot is below, half above the middle between ankle and ground.
    middle = -0.5 * ankle
    whole = gyration(
        kg["foot"],
        np.array([heel + row.com * length, 0.0, middle]),
        length * np.array([row.longitudinal, row.sagittal, row.transverse]),
    )
    toes = box(mass, np.array([ball + 0.5 * sizes[0], 0.0, middle]), np.array([*sizes, thick]))
    joint = np.array([ball, 0.0, middle])
    segments[f"{side}Foot"] = remove(whole, toes)
    segments[f"{side}Toe"] = toes.moved(-joint)
    placements[f"j{side}BallFoot"] = ends[f"{side}Foot"] = joint
    ends[f"{side}Toe"] = np.array([sizes[0], 0.0, 0.0])


def _depth_first(link: str) -> list[str]:
    """A segment and all that hang on it, in the order in which URDF readers take them (by the joints' names)."""
    below = [JOINTS[joint][1] for joint in sorted(JOINTS) if JOINTS[joint][0] == link]
    return [link, *(other for child in below for other in _depth_first(child))]
