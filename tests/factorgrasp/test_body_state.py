"""Configurations from markers and from poses of links, against a known motion, and their covariances against errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from factorgrasp import cli, lie
from factorgrasp.body_state import BodyState, estimate_state
from factorgrasp.body_state_prior import jerk_scale, third_difference_band
from factorgrasp.errors import InputError
from factorgrasp.problems.body_observations import (
    BodyObservations,
    ObservedBody,
    Placement,
    placement_of,
    poses_only,
)
from factorgrasp.problems.link_motion_pinocchio import PinocchioTree
from factorgrasp.recordings.opensim import read_trc
from factorgrasp.recordings.trc import write_trc
from factorgrasp.simulation.human_dynamics import HumanRecording, human_carrying
from factorgrasp.simulation.human_dynamics_files import write_recording
from factorgrasp.solvers.block_tridiagonal import BlockTridiagonal
from factorgrasp.typing import FloatArray

SD = 0.001
FRAMES = slice(100, 320)


@pytest.fixture(scope="module")
def walking() -> HumanRecording:
    return human_carrying(0, motion="walking")


def marker_set(recording: HumanRecording) -> Placement:
    return placement_of({name: (link, point, SD) for name, (link, point) in recording.body.markers.items()})


def true_markers(recording: HumanRecording, frames: slice) -> FloatArray:
    placement = marker_set(recording)
    body = ObservedBody(
        recording.body.model(), BodyObservations(placement, np.zeros((1, len(placement.names), 3)))
    )
    return body.markers(recording.truth.trajectory.q[frames])


@pytest.fixture(scope="module")
def seen(walking: HumanRecording) -> BodyObservations:
    y = true_markers(walking, FRAMES)
    rng = np.random.default_rng(7)
    y = y + SD * rng.normal(size=y.shape)
    y[rng.random(y.shape[:2]) < 0.03] = np.nan
    # One marker hidden for long, and a whole hand for half a second.
    placement = marker_set(walking)
    y[60:120, placement.names.index("RightLowerLeg_2")] = np.nan
    y[140:190, [k for k, link in enumerate(placement.links) if link == "LeftHand"]] = np.nan
    return BodyObservations(placement, y)


@pytest.fixture(scope="module")
def state(walking: HumanRecording, seen: BodyObservations) -> BodyState:
    return estimate_state(walking.body.model(), walking.t[FRAMES], seen)


def test_residuals_by_finite_differences(
    walking: HumanRecording, seen: BodyObservations, rng: np.random.Generator
) -> None:
    model = walking.body.model("spherical")
    tree = PinocchioTree(walking.body.model())
    motion = tree.motion(walking.t[:3], *(x[:3] for x in walking.truth.trajectory[1:]))
    links = [motion.link(name) for name in ("Pelvis", "RightHand")]
    turn = lie.so3_exp(rng.normal(0.0, 0.01, (3, 2, 3)).reshape(-1, 3)).reshape(3, 2, 3, 3)
    measured = poses_only(("Pelvis", "RightHand"), motion.R[:, links] @ turn, motion.p[:, links] + 0.01)
    both = BodyObservations(seen.placement, seen.markers[:3], measured.posed, measured.R, measured.p)
    for made in (walking.body.model(), model):
        body = ObservedBody(made, both)
        q = np.tile(np.asarray(pin.neutral(made)), (3, 1))
        q = body.step(q, rng.normal(0.0, 0.3, (3, made.nv)))
        r, J = body.residuals(q)
        # Rows of orientations are linear only near the measured one.
        rows = slice(0, r.shape[1] - 6)
        for _ in range(3):
            d = rng.normal(size=(3, made.nv))
            up, down = (body.residuals(body.step(q, s * 1e-6 * d))[0] for s in (1.0, -1.0))
            np.testing.assert_allclose(
                ((up - down) / 2e-6)[:, rows], (J @ d[..., None])[:, rows, 0], rtol=1e-5, atol=1e-3
            )
        np.testing.assert_allclose(body.difference(q, body.step(q, d)), d, atol=1e-9) if np.abs(
            d
        ).max() < 3 else None


def test_block_tridiagonal_equals_dense(rng: np.random.Generator) -> None:
    count, size = 5, 4
    whole = np.zeros((count * size, count * size))
    A = rng.normal(size=(count * size, count * size))
    full = A @ A.T + count * size * np.eye(count * size)
    D = np.array([full[size * k : size * (k + 1), size * k : size * (k + 1)] for k in range(count)])
    L = np.array([full[size * (k + 1) : size * (k + 2), size * k : size * (k + 1)] for k in range(count - 1)])
    for k in range(count):
        whole[size * k : size * (k + 1), size * k : size * (k + 1)] = D[k]
    for k in range(count - 1):
        whole[size * (k + 1) : size * (k + 2), size * k : size * (k + 1)] = L[k]
        whole[size * k : size * (k + 1), size * (k + 1) : size * (k + 2)] = L[k].T
    system = BlockTridiagonal(D, L)
    b = rng.normal(size=(count, size))
    np.testing.assert_allclose(system.solve(b).ravel(), np.linalg.solve(whole, b.ravel()), rtol=1e-9)
    inverse = np.linalg.inv(whole)
    Z, above = system.inverse_band()
    for k in range(count):
        np.testing.assert_allclose(
            Z[k], inverse[size * k : size * (k + 1), size * k : size * (k + 1)], atol=1e-12
        )
    for k in range(count - 1):
        np.testing.assert_allclose(
            above[k], inverse[size * k : size * (k + 1), size * (k + 1) : size * (k + 2)], atol=1e-12
        )


def test_third_differences_band() -> None:
    D = np.diff(np.eye(9), n=3, axis=0)
    band = third_difference_band(9)
    for off in range(4):
        np.testing.assert_allclose(np.diag(D.T @ D, -off), band[off, : 9 - off])


@pytest.mark.parametrize("jerk", [1e-5, 1e-4, 1e-3])
def test_jerk_of_a_motion_is_found(jerk: float, rng: np.random.Generator) -> None:
    """Integrated white noise with noise on top: the prior's scale within a factor of two."""
    x = np.cumsum(np.cumsum(np.cumsum(jerk * rng.normal(size=(600, 12)), axis=0), axis=0), axis=0)
    found, factor = jerk_scale(x + 1e-3 * rng.normal(size=x.shape), np.full(12, 1e-6), 0.01)
    # The liveliest stretch decides: not below the truth, and not much above it.
    assert 0.9 < np.median(found) / jerk < 2.5
    assert np.median(factor) == pytest.approx(1.0, abs=0.4)


def test_motion_is_found_through_gaps(
    walking: HumanRecording, seen: BodyObservations, state: BodyState
) -> None:
    body = ObservedBody(walking.body.model(), seen)
    q, v, a = (x[FRAMES] for x in walking.truth.trajectory[1:])
    assert state.good.sum() > 150
    good = state.good
    error = body.difference(q[good], state.q[good])
    assert np.sqrt(np.mean(error[:, 3:] ** 2)) < 0.006
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.0005
    assert np.sqrt(np.mean((state.qd[good] - v[good]) ** 2)) < 0.06
    assert np.sqrt(np.mean((state.qdd[good] - a[good]) ** 2)) < 0.8
    assert state.residual_sd == pytest.approx(1.0, abs=0.05)
    # Where the whole hand was hidden nobody knows its wrist: a gap, not a guess.
    assert not good[155:175].any()
    assert np.isnan(state.q[~good]).all()


def test_covariance_of_the_configuration_is_honest(
    walking: HumanRecording, seen: BodyObservations, state: BodyState
) -> None:
    """NEES; below one, as the prior must believe in moves that this gentle walk does not make."""
    body = ObservedBody(walking.body.model(), seen)
    good = state.good
    error = body.difference(walking.truth.trajectory.q[FRAMES][good], state.q[good])
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(state.q_covariance[good], error[..., None])[..., 0])
    assert 0.6 < nees.mean() / error.shape[1] < 1.1
    v, a = (x[FRAMES][good] for x in walking.truth.trajectory[2:])
    for found, true, variance in ((state.qd, v, state.qd_variance), (state.qdd, a, state.qdd_variance)):
        share = np.mean((found[good] - true)[:, 6:] ** 2 / variance[good][:, 6:], axis=0)
        assert 0.1 < np.median(share) < 1.1
        # A hip that lifts the leg is for a moment livelier than its prior.
        assert np.mean(share) < 1.6


def test_poses_of_links_give_the_motion(walking: HumanRecording) -> None:
    """A suit's orientations and positions, 17 trackers, 0.01 rad and 5 mm."""
    model = walking.body.model()
    frames = slice(150, 230)
    truth = walking.truth.motion
    links = ("Pelvis", "L3", "T8", "Head", "RightUpperArm", "LeftUpperArm", "RightForeArm", "LeftForeArm", "RightHand", "LeftHand",
             "RightUpperLeg", "LeftUpperLeg", "RightLowerLeg", "LeftLowerLeg", "RightFoot", "LeftFoot", "RightShoulder")  # fmt: skip
    at = [truth.link(link) for link in links]
    rng = np.random.default_rng(3)
    R = truth.R[frames][:, at]
    R = R @ lie.so3_exp(0.01 * rng.normal(size=(R.shape[0] * R.shape[1], 3))).reshape(R.shape)
    p = truth.p[frames][:, at] + 0.005 * rng.normal(size=(*R.shape[:2], 3))
    found = estimate_state(model, walking.t[frames], poses_only(links, R, p))
    body = ObservedBody(model, poses_only(links, R, p))
    error = body.difference(walking.truth.trajectory.q[frames][found.good], found.q[found.good])
    names = [str(name) for name in list(model.names)[2:]]
    elbow = 6 + names.index("jLeftElbow_z")
    assert np.sqrt(np.mean(error[:, elbow] ** 2)) < 0.02
    assert found.residual_sd == pytest.approx(1.0, abs=0.1)
    nees = np.mean(error**2 / found.q_variance[found.good])
    assert 0.4 < nees < 1.2


def test_markers_come_back_from_a_trc_file(tmp_path: Path, rng: np.random.Generator) -> None:
    position = rng.normal(size=(6, 3, 3))
    position[2, 1] = np.nan
    read = read_trc(write_trc(tmp_path / "m.trc", np.arange(6) / 50.0, ("A", "B.x", "C"), position))
    assert read.names == ("A", "B.x", "C")
    assert read.rate == 50.0
    np.testing.assert_allclose(read.position, position, atol=1e-8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Carrying, as markers; the first half second stands still in a known posture."""
    recording = human_carrying(1, motion="standing")
    path = tmp_path_factory.mktemp("markers")
    problem = write_recording(recording, path)
    rng = np.random.default_rng(2)
    y = true_markers(recording, slice(0, 160))
    y = y + SD * rng.normal(size=y.shape)
    write_trc(path / "carrying.trc", recording.t[:160], marker_set(recording).names, y)
    text = problem.read_text(encoding="utf-8")
    motion = 'trc = "carrying.trc"\nmarker_sd = 0.001\n'
    (path / "problem.toml").write_text(
        text[: text.index("[motion]")] + "[motion]\n" + motion + "\n" + text[text.index("[[forces]]") :],
        encoding="utf-8",
    )
    return path


def run(path: Path, out: Path) -> tuple[int, str]:
    answer = CliRunner().invoke(cli.app, ["solve", str(path), "--out", str(out), "--export", "csv"])
    return answer.exit_code, answer.output


def test_markers_to_payload_by_the_command_line(folder: Path, tmp_path: Path) -> None:
    code, output = run(folder / "problem.toml", tmp_path)
    assert code == 0, output
    with np.load(tmp_path / "estimate.npz") as arrays:
        assert arrays["torque"].shape == (160, 66)
        assert arrays["q"].shape == (160, 73)
        assert np.nanmean(arrays["payload_mass"]) == pytest.approx(9.55, abs=0.15)
        with np.load(folder / "truth.npz") as truth:
            names = [str(name) for name in truth["dof_names"]]
            at = [list(arrays["dof_names"]).index(name) for name in names]
            legs = [k for k, name in enumerate(names) if "Knee" in name or "Ankle" in name]
            error = (arrays["torque"][:, at] - truth["torque"][:160])[:, legs]
            share = error**2 / arrays["torque_sd"][:, at][:, legs] ** 2
        assert np.sqrt(np.nanmean(error**2)) < 1.0
        assert np.nanmean(share) < 1.5
    assert (tmp_path / "estimate.csv").is_file()


def test_markers_without_a_position_are_calibrated(folder: Path, tmp_path: Path) -> None:
    """Three quarters of the markers are only said to sit on a link; the posture of the first frames tells where."""
    text = (folder / "problem.toml").read_text(encoding="utf-8")
    recording = human_carrying(1, motion="standing")
    rows = []
    for name, (link, point) in recording.body.markers.items():
        known = link in ("Pelvis", "T8", "Head", "RightFoot", "LeftFoot", "RightHand", "LeftHand")
        rows.append(
            f'{name} = {{ link = "{link}", position = {[float(x) for x in point]} }}'
            if known
            else f'{name} = "{link}"'
        )
    q = recording.truth.trajectory.q[10]
    names = [str(name) for name in list(recording.truth.model.names)[2:]]
    posture = ", ".join(f"{name} = {float(value):.9f}" for name, value in zip(names, q[7:], strict=True))
    more = "static = [0.0, 0.2]\nstatic_posture = { " + posture + ' }\nmarkers = "markers.toml"\n'
    (folder / "markers.toml").write_text("[markers]\n" + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / "calibrated.toml").write_text(
        text.replace("marker_sd = 0.001\n", "marker_sd = 0.002\n" + more), encoding="utf-8"
    )
    code, output = run(folder / "calibrated.toml", tmp_path)
    assert code == 0, output
    with np.load(tmp_path / "estimate.npz") as arrays:
        assert np.nanmean(arrays["payload_mass"]) == pytest.approx(9.55, abs=0.3)
    (folder / "calibrated.toml").write_text(
        text.replace("marker_sd = 0.001\n", 'markers = "markers.toml"\n'), encoding="utf-8"
    )
    code, output = run(folder / "calibrated.toml", tmp_path)
    assert code == 2
    assert "expected a position in the frame of its link" in output


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("marker_sd = 0.001", "marker_sd = 0", "marker_sd"),
        ("marker_sd = 0.001", "marker_sd = 0.001\nstart = 100", "five frames"),
        ("marker_sd = 0.001", "marker_sd = 0.001\nangle_sd = 1", "angle_sd: expected a known key"),
        (
            "marker_sd = 0.001",
            'markers = { RASI = { link = "Pelvis", position = [0, 0, 0] } }',
            "at least three of RASI",
        ),
        (
            "marker_sd = 0.001",
            'markers = { Head_1 = "Hed", Head_2 = "Head", Head_3 = "Head" }\nstatic = [0, 1]',
            "at least three markers that do not lie on a line",
        ),
        ("marker_sd = 0.001", "markers = { Head_1 = 3 }", "Head_1"),
        ("marker_sd = 0.001", 'markers = "none.osim"', "none.osim"),
        ('sex = "male"', 'sex = "male"\ngravity = [0, -9.80665, 0]', "upright along z"),
        ("carrying.trc", "none.trc", "no such file"),
    ],
)
def test_what_is_wrong_with_markers_is_named(
    folder: Path, tmp_path: Path, old: str, new: str, words: str
) -> None:
    text = (folder / "problem.toml").read_text(encoding="utf-8")
    assert old in text
    text = text.replace(old, new, 1)
    text = text if "start" in new else text.replace("[motion]", "[motion]\nend = 0.2", 1)
    (folder / "wrong.toml").write_text(text, encoding="utf-8")
    code, output = run(folder / "wrong.toml", tmp_path)
    assert code == 2, output
    assert words in output.replace("\n", " ")


def test_wrong_size_of_the_body_is_said(folder: Path, tmp_path: Path) -> None:
    text = (folder / "problem.toml").read_text(encoding="utf-8").replace("height = 1.75", "height = 1.6")
    (folder / "small.toml").write_text(
        text.replace("marker_sd = 0.001\n", "marker_sd = 0.001\nend = 0.5\n"), encoding="utf-8"
    )
    code, output = run(folder / "small.toml", tmp_path)
    assert code == 0
    assert "times worse than its stated sd" in output.replace("\n", " ")


def test_too_little_is_an_error(walking: HumanRecording, seen: BodyObservations) -> None:
    model, t = walking.body.model(), walking.t[FRAMES]
    with pytest.raises(InputError, match="at least five"):
        estimate_state(model, t[:3], seen.select(slice(0, 3)))
    with pytest.raises(InputError, match="uniform"):
        estimate_state(model, t**1.5, seen)
    blind = BodyObservations(seen.placement, np.full_like(seen.markers, np.nan))
    with pytest.raises(InputError, match="at least three"):
        estimate_state(model, t, blind)


def test_suit_to_payload_by_the_command_line(tmp_path: Path) -> None:
    """Poses of 18 segments: some vertebrae between them are free to share an error, which must not reach the mass."""
    recording = human_carrying(0, motion="standing")
    problem = write_recording(recording, tmp_path)
    truth, rng = recording.truth.motion, np.random.default_rng(0)
    parts = ("Shoulder", "UpperArm", "ForeArm", "Hand", "UpperLeg", "LowerLeg", "Foot")
    sides = [f"{side}{part}" for part in parts for side in ("Right", "Left")]
    links = ["Pelvis", "L3", "T8", "Head", *sides]
    at = [truth.link(link) for link in links]
    R = truth.R[:150][:, at]
    R = R @ lie.so3_exp(0.005 * rng.normal(size=(R.shape[0] * R.shape[1], 3))).reshape(R.shape)
    p = truth.p[:150][:, at] + 0.002 * rng.normal(size=(*R.shape[:2], 3))
    np.savez(tmp_path / "suit.npz", t=recording.t[:150], bodies=np.array(["Hips", *links[1:]]), R=R, p=p)
    text = problem.read_text(encoding="utf-8")
    motion = '[motion]\nlinks = "suit.npz"\norientation_sd = 0.005\nposition_sd = 0.002\nbodies = { Hips = "Pelvis" }\n'
    head = text[: text.index("[motion]")].rstrip() + "\ngravity = [0, 0, -9.80665]\n"
    (tmp_path / "suit.toml").write_text(head + motion + text[text.index("[[forces]]") :], encoding="utf-8")
    code, output = run(tmp_path / "suit.toml", tmp_path / "out")
    assert code == 0, output
    with np.load(tmp_path / "out" / "estimate.npz") as arrays:
        assert np.nanmean(arrays["payload_mass"]) == pytest.approx(9.55, abs=0.25)


def test_long_recordings_keep_means(
    walking: HumanRecording, seen: BodyObservations, state: BodyState, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows and means of covariances give what the whole gives, where both exist."""
    from factorgrasp import body_state_smoother

    model, t, part = walking.body.model(), walking.t[FRAMES], seen
    for name, value in (("WINDOW", 150), ("OVERLAP", 0.375), ("WHOLE", 100)):
        monkeypatch.setattr(body_state_smoother, name, value)
    pieces = estimate_state(model, t, part)
    assert pieces.qdd_covariance.shape == (model.nv, model.nv)
    assert pieces.q_covariance.shape == (76, model.nv, model.nv)
    good = state.good & pieces.good
    # Windows overlap by more than the prior remembers: differences are far below what is not known anyway.
    error = ObservedBody(model, part).difference(state.q[good], pieces.q[good])
    assert np.sqrt(np.mean(error**2 / state.q_variance[good])) < 0.1
    assert np.median(pieces.q_variance / state.q_variance) == pytest.approx(1.0, abs=0.02)
    assert np.median(np.diagonal(pieces.qdd_covariance) / state.qdd_variance.mean(axis=0)) == pytest.approx(
        1.0, abs=0.05
    )
