"""OpenSim models: kinematics in closed form and against OpenSim's own, generalised forces against published ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from factorgrasp import cli
from factorgrasp.body_state import estimate_state
from factorgrasp.errors import InputError
from factorgrasp.models.osim import read_osim
from factorgrasp.models.osim_functions import simm_spline
from factorgrasp.problem_file import load_problem
from factorgrasp.problems.body_observations import BodyObservations, placement_of
from factorgrasp.problems.link_motion_files import load_links
from factorgrasp.problems.link_motion_osim import from_osim
from factorgrasp.problems.observed_osim import observed
from factorgrasp.recordings.opensim import read_storage
from factorgrasp.recordings.trc import write_trc

Find = Callable[[str], Path]


def body(name: str) -> str:
    return f'<Body name="{name}"><mass>2</mass><mass_center>0 -0.2 0</mass_center><inertia>0.1 0.05 0.1 0 0 0</inertia></Body>'


def frames(parent: str, child: str, offset: str) -> str:
    return (
        f"<socket_parent_frame>{parent}_o</socket_parent_frame><socket_child_frame>/bodyset/{child}</socket_child_frame>"
        f'<frames><PhysicalOffsetFrame name="{parent}_o"><socket_parent>/bodyset/{parent}</socket_parent>'
        f"<translation>{offset}</translation><orientation>0 0 0</orientation></PhysicalOffsetFrame></frames>"
    )


def coordinate(name: str, low: float = -6.0, high: float = 6.0) -> str:
    return f'<Coordinate name="{name}"><default_value>0</default_value><range>{low} {high}</range><locked>false</locked></Coordinate>'


def axis(kind: str, direction: str, name: str, function: str) -> str:
    return f'<TransformAxis name="{kind}"><coordinates>{name}</coordinates><axis>{direction}</axis>{function}</TransformAxis>'


LINEAR = '<LinearFunction name="function"><coefficients>1 0</coefficients></LinearFunction>'
SPLINE = '<SimmSpline name="function"><x>-2 -1 0 1 2</x><y>-0.08 -0.01 0 0.01 0.08</y></SimmSpline>'


@pytest.fixture
def leg(tmp_path: Path) -> Path:
    """A thigh that moves freely in a plane, and a shank whose knee slides by 0.01 q^3 as it bends by q."""
    root = axis("rotation1", "0 0 1", "tilt", LINEAR)
    root += axis("translation1", "1 0 0", "tx", LINEAR) + axis("translation2", "0 1 0", "ty", LINEAR)
    knee = axis("rotation1", "0 0 1", "knee", LINEAR) + axis("translation1", "1 0 0", "knee", SPLINE)
    places = {
        "thigh": ("0.05 0 0", "0 -0.3 0.05", "0 -0.1 -0.05"),
        "shank": ("0.05 -0.1 0", "0 -0.3 0.05", "0.02 -0.2 -0.05"),
    }
    markers = "".join(
        f'<Marker name="{link}{k}"><socket_parent_frame>/bodyset/{link}</socket_parent_frame><location>{at}</location></Marker>'
        for link, several in places.items()
        for k, at in enumerate(several)
    )
    text = (
        '<?xml version="1.0"?><OpenSimDocument Version="40000"><Model name="leg"><gravity>0 -9.80665 0</gravity>'
        f"<BodySet><objects>{body('thigh')}{body('shank')}</objects></BodySet><JointSet><objects>"
        f'<CustomJoint name="knee">{frames("thigh", "shank", "0 -0.4 0")}<coordinates>{coordinate("knee", -2.0, 2.0)}</coordinates>'
        f"<SpatialTransform>{knee}</SpatialTransform></CustomJoint>"
        '<CustomJoint name="root"><socket_parent_frame>/ground</socket_parent_frame><socket_child_frame>/bodyset/thigh</socket_child_frame>'
        f"<coordinates>{coordinate('tilt')}{coordinate('tx')}{coordinate('ty')}</coordinates><SpatialTransform>{root}</SpatialTransform></CustomJoint>"
        f"</objects></JointSet><MarkerSet><objects>{markers}</objects></MarkerSet></Model></OpenSimDocument>"
    )
    path = tmp_path / "leg.osim"
    path.write_text(text, encoding="utf-8")
    return path


def test_poses_in_closed_form(leg: Path) -> None:
    model = read_osim(leg)
    assert model.names == ("knee", "tilt", "tx", "ty")
    knee, tilt = 0.7, -0.3
    R, p = model.poses(np.array([[knee, tilt, 0.2, 0.9]]))
    c, s = np.cos(tilt), np.sin(tilt)
    np.testing.assert_allclose(p[0, 0], [0.2, 0.9, 0.0], atol=1e-12)
    slide = 0.01 * knee**3
    np.testing.assert_allclose(
        p[0, 1], [0.2 + c * slide + 0.4 * s, 0.9 + s * slide - 0.4 * c, 0.0], atol=1e-12
    )
    c, s = np.cos(tilt + knee), np.sin(tilt + knee)
    np.testing.assert_allclose(R[0, 1], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-12)


def test_spline_keeps_cubics_and_goes_on_straight() -> None:
    x = np.array([0.0, 0.4, 1.0, 1.5, 2.5])
    spline = simm_spline(x, 2.0 * x**3 - x + 1.0)
    at = np.linspace(0.0, 2.5, 23)
    np.testing.assert_allclose(spline(at), 2.0 * at**3 - at + 1.0, atol=1e-12)
    np.testing.assert_allclose(
        spline(np.array([3.5])), 2.0 * 2.5**3 - 2.5 + 1.0 + (6.0 * 2.5**2 - 1.0), atol=1e-10
    )


def test_generalised_force_of_a_sliding_knee(leg: Path) -> None:
    """Virtual work of gravity: the torque of the knee at rest is the slope of the shank's potential energy."""
    from factorgrasp.baselines.inverse_dynamics import inverse_dynamics

    model = read_osim(leg)
    q = np.array([[0.9, 0.3, 0.0, 1.0]])
    zero = np.zeros_like(q)
    found = inverse_dynamics(from_osim(model, np.zeros(1), q, zero, zero))

    def energy(knee: float) -> float:
        R, p = model.poses(np.array([[knee, 0.3, 0.0, 1.0]]))
        return float(2.0 * 9.80665 * (p[0, 1] + R[0, 1] @ [0.0, -0.2, 0.0])[1])

    slope = (energy(0.9 + 1e-5) - energy(0.9 - 1e-5)) / 2e-5
    assert found.torque[0, 0] == pytest.approx(slope, abs=1e-6)


def test_motion_is_the_derivative_of_poses(leg: Path) -> None:
    model = read_osim(leg)
    t = np.arange(5) * 1e-4
    q = np.column_stack([np.sin(3.0 * (t + k)) for k in range(4)])
    qd = np.column_stack([3.0 * np.cos(3.0 * (t + k)) for k in range(4)])
    motion = from_osim(model, t, q, qd, -9.0 * q)
    np.testing.assert_allclose(motion.velocity[2], (motion.p[3] - motion.p[1]) / 2e-4, atol=2e-5)
    np.testing.assert_allclose(
        motion.acceleration[2], (motion.velocity[3] - motion.velocity[1]) / 2e-4, atol=2e-4
    )
    np.testing.assert_allclose(
        motion.angular_acceleration[2],
        (motion.angular_velocity[3] - motion.angular_velocity[1]) / 2e-4,
        atol=2e-4,
    )


def test_markers_give_the_coordinates(leg: Path, rng: np.random.Generator) -> None:
    model = read_osim(leg)
    t = np.arange(200) * 0.01
    q = np.column_stack(
        [-1.0 + 0.5 * np.sin(3.0 * t), 2.5 + 0.4 * np.sin(2.0 * t), 0.5 * t, 0.9 + 0.05 * np.cos(4.0 * t)]
    )
    placement = placement_of({name: (link, point, 0.002) for name, (link, point) in model.markers.items()})
    truth = observed(model, BodyObservations(placement, np.zeros((1, 6, 3)))).markers(q)
    seen = BodyObservations(placement, truth + 0.002 * rng.normal(size=truth.shape))
    r, J = observed(model, seen).residuals(q)
    for k in range(4):
        step = np.eye(4)[k] * 1e-6
        up, down = (observed(model, seen).residuals(q + s * step)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(J[:, :, k], (up - down) / 2e-6, atol=1e-3)
    assert np.mean(r**2) == pytest.approx(1.0, abs=0.1)
    found = estimate_state(model, t, seen)
    error = found.q[found.good] - q[found.good]
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 0.01
    assert 0.4 < np.mean(error**2 / found.q_variance[found.good]) < 1.4


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('<CustomJoint name="knee">', '<RollingJoint name="knee">', "mismatched tag"),
        ("0 -0.2 0</mass_center>", "0 x 0</mass_center>", "mass_center: expected 3 number"),
        (
            "/bodyset/shank</socket_child_frame>",
            "/bodyset/thigh</socket_child_frame>",
            "one joint to a parent for every body",
        ),
        ("<SimmSpline name", "<Sine name", "mismatched tag"),
        ("-2 -1 0 1 2</x>", "-2 -1 0 1 1</x>", "increasing x"),
        ('<Body name="shank">', '<Body name="thigh">', "names of their own"),
    ],
)
def test_what_is_wrong_with_a_model_is_named(leg: Path, old: str, new: str, words: str) -> None:
    text = leg.read_text(encoding="utf-8")
    assert old in text
    leg.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_osim(leg)


def test_coordinates_and_markers_by_the_command_line(leg: Path) -> None:
    """The same motion as coordinates in degrees and as markers: the same torque of the knee."""
    model, folder = read_osim(leg), leg.parent
    t = np.arange(150) * 0.01
    q = np.column_stack(
        [-1.0 + 0.5 * np.sin(3.0 * t), 0.4 * np.sin(2.0 * t), 0.5 * t, 0.9 + 0.05 * np.cos(4.0 * t)]
    )
    rows = "\n".join(
        "\t".join(f"{x:.9f}" for x in (s, *np.degrees(v[:2]), *v[2:])) for s, v in zip(t, q, strict=True)
    )
    header = "leg\nversion=1\nnRows=150\nnColumns=5\ninDegrees=yes\nendheader\n"
    (folder / "leg.mot").write_text(header + "time\tknee\ttilt\ttx\tty\n" + rows + "\n", encoding="utf-8")
    placement = placement_of({name: (link, point, 1e-4) for name, (link, point) in model.markers.items()})
    points = observed(model, BodyObservations(placement, np.zeros((1, 6, 3)))).markers(q)
    write_trc(folder / "leg.trc", t, placement.names, points)
    torque = {}
    for name in ("leg.mot", "leg.trc"):
        more = "marker_sd = 1e-4\n" if name.endswith("trc") else ""
        (folder / "leg.toml").write_text(
            f'kind = "human_dynamics"\n[model]\nosim = "leg.osim"\n[motion]\nfile = "{name}"\n{more}[contacts]\nunmeasured = ["thigh"]\n',
            encoding="utf-8",
        )
        run = CliRunner().invoke(cli.app, ["solve", str(folder / "leg.toml"), "--out", str(folder / "out")])
        assert run.exit_code == 0, run.output
        with np.load(folder / "out" / "estimate.npz") as arrays:
            assert arrays["dof_names"].tolist() == ["knee"]
            torque[name] = arrays["torque"][20:-20, 0]
    np.testing.assert_allclose(torque["leg.mot"], torque["leg.trc"], atol=0.1)
    assert np.ptp(torque["leg.mot"]) > 1.0
    radians = (folder / "leg.mot").read_text(encoding="utf-8").replace("inDegrees=yes", "inDegrees=no")
    (folder / "leg.mot").write_text(radians, encoding="utf-8")
    (folder / "leg.toml").write_text(
        'kind = "human_dynamics"\n[model]\nosim = "leg.osim"\n[motion]\nfile = "leg.mot"\n', encoding="utf-8"
    )
    run = CliRunner().invoke(cli.app, ["solve", str(folder / "leg.toml"), "--out", str(folder / "out")])
    assert run.exit_code == 2
    assert "Degrees" in run.output


@pytest.mark.parametrize(
    ("model", "links"),
    [
        ("opensim_walk_gait2354/subject01_simbody.osim", "opensim_walk_gait2354/links_walk.npz"),
        ("opencap_squat/optimized_scale_and_markers.osim", "opencap_squat/links_squat.npz"),
    ],
)
def test_kinematics_equal_those_of_opensim(dataset: Find, model: str, links: str) -> None:
    osim, archive = read_osim(dataset(model)), dataset(links)
    with np.load(archive) as data:
        names = data["names"].tolist()
        every = slice(None, None, 10)
        q, qd, qdd = (
            data[key][every][:, [names.index(n) for n in osim.names]].astype(float)
            for key in ("Q", "dQ", "ddQ")
        )
        t = data["t"][every].astype(float)
    known = load_links(archive).select(every)
    found = from_osim(osim, t, q, qd, qdd)
    at = [known.links.index(link) for link in found.links]
    np.testing.assert_allclose(found.R, known.R[:, at], atol=1e-6)
    np.testing.assert_allclose(found.p, known.p[:, at], atol=1e-6)
    np.testing.assert_allclose(found.velocity, known.velocity[:, at], atol=1e-3)
    np.testing.assert_allclose(found.acceleration, known.acceleration[:, at], atol=0.1)
    np.testing.assert_allclose(found.inertia, known.inertia[at])


def test_published_generalised_forces_of_walking(dataset: Find, tmp_path: Path) -> None:
    """Model, coordinates and plates as OpenSim has them, and nothing else: its inverse dynamics, the sliding knee included."""
    folder = dataset("opensim_walk_gait2354")
    model, motion, plates = (
        folder / name
        for name in ("subject01_simbody.osim", "subject01_walk1_ik.mot", "subject01_walk1_grf.xml")
    )
    (tmp_path / "walk.toml").write_text(
        f'kind = "human_dynamics"\n[model]\nosim = "{model}"\n[motion]\nmot = "{motion}"\n[forces]\nfile = "{plates}"\n'
        '[contacts]\nunmeasured = "pelvis"\n'
        "[covariance]\nplate = [1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4]\n",
        encoding="utf-8",
    )
    run = CliRunner().invoke(cli.app, ["solve", str(tmp_path / "walk.toml"), "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    published = read_storage(folder / "ANSWERS_inverse_dynamics.sto")
    with np.load(tmp_path / "estimate.npz") as found:
        for k, name in enumerate(found["dof_names"].tolist()):
            column = next(c for c in published.names if c.startswith(name))
            error = np.interp(
                published.t, found["t"], found["torque"][:, k], np.nan, np.nan
            ) - published.column(column)
            assert np.sqrt(np.nanmean(error**2)) < 1.5, name


def test_coordinates_of_an_archive(dataset: Find, tmp_path: Path) -> None:
    """Model and archive: moments at the joints' centres as from the archive's own poses, and generalised forces beside them."""
    archive, model = (
        dataset("opensim_walk_gait2354/links_walk.npz"),
        dataset("opensim_walk_gait2354/subject01_simbody.osim"),
    )
    found = {}
    for name, more in (("osim", f'[model]\nosim = "{model}"\n'), ("links", "")):
        (tmp_path / "p.toml").write_text(
            f'kind = "human_dynamics"\n{more}[motion]\nlinks = "{archive}"\nevery = 10\n[contacts]\nunmeasured = ["pelvis"]\n',
            encoding="utf-8",
        )
        result = load_problem(tmp_path / "p.toml").solve()
        arrays = result.arrays()
        order = [
            arrays["joint_names"].tolist().index(joint) for joint in ("hip_r", "knee_l", "ankle_r", "back")
        ]
        found[name] = arrays["joint_moment"][:, order]
        if name == "osim":
            assert arrays["torque"].shape == (found[name].shape[0], 17)
            assert "force on calcn_r" in {one.name for one in result.frames.innovations}
    # Rows of joints and rows of links weigh the same motion a little differently.
    assert np.sqrt(np.mean((found["osim"] - found["links"]) ** 2)) < 3.0
