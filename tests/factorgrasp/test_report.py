from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Ellipse

from factorgrasp import grasp_scene, plots, solve
from factorgrasp.estimate import Certificate, Estimate, TermSummary
from factorgrasp.lie import so3_exp
from factorgrasp.observability import Direction, Observability
from factorgrasp.problems import GraspPose, GraspPoseEstimate
from factorgrasp.report import build_report, decimals, quantity, render, significant, write_report
from factorgrasp.results import finite, write_result
from factorgrasp.simulation.cehajic2015 import cehajic2015
from factorgrasp.status import Status
from factorgrasp.variables import Variable


class _Page(HTMLParser):
    """Checks that elements nest, and collects the text."""

    VOID = frozenset({"meta", "br", "img", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())


@pytest.fixture(scope="module")
def grasp() -> GraspPoseEstimate:
    recording = cehajic2015(4, duration=15.0, time_offset=0.02)
    gap = recording.hand.t < 6.0
    gap |= recording.hand.t > 8.0
    hand = replace(
        recording.hand,
        t=recording.hand.t[gap],
        angular_velocity=recording.hand.angular_velocity[gap],
        specific_force=recording.hand.specific_force[gap],
    )
    estimate = solve(GraspPose(robot=recording.robot, hand=hand, gravity=recording.gravity))
    assert isinstance(estimate, GraspPoseEstimate)
    return estimate


@pytest.fixture(scope="module")
def page(grasp: GraspPoseEstimate) -> str:
    return render(build_report(grasp), grasp.estimate, "first day", "grasp.toml")


def made_up(**changes: object) -> Estimate:
    base = Estimate(
        Status.SOLVED,
        "made_up",
        "cholesky",
        (Variable("mass", 1, unit="kg"), Variable("turn", 3, "rotation", unit="rad")),
        {"mass": np.array([2.5]), "turn": np.eye(3)},
        residuals=(TermSummary("scale_reading", 12, 11.0, 0.957, 2.2, 0.25),),
        observability=Observability(
            (
                Direction("mass", np.ones(1), np.inf, 0.1, "mass <b>", "kg"),
                Direction("turn", np.ones(3), 0.001, 0.1, "turn about x", "rad"),
            ),
            "Lift it.",
        ),
        certificate=Certificate(1e-12, 1e-11, 1e-13),
        timing={"solve": 0.00025},
        versions={"factorgrasp": "0"},
        covariance_source=lambda columns: np.diag([0.04, 1e-6, 1e-6, 1e-6]) @ columns,
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def test_grasp_report_says_what_was_found(grasp: GraspPoseEstimate, page: str) -> None:
    text = _Page(page).text
    assert "first day" in text
    assert "The hand is 1.12" in text
    for value in grasp.translation:
        assert f"{1000.0 * value:.0f}"[:-1] in text
    offset = re.search(r"([0-9.]+) ms ± ([0-9.]+) ms the hand's clock is ahead of", text)
    assert offset
    assert abs(float(offset[1]) - 20.0) < 5.0 * float(offset[2])
    for title in ("The grasp", "What the motion showed", "How well both sides agree", "Use of the data"):
        assert title in text
    row = re.search(r"hand (\d+) ([0-9.]+) s", text)
    assert row
    assert row[1] == "1"
    assert abs(float(row[2]) - 2.0) < 0.01
    assert f"{grasp.diagnostics.windows_dropped} touch a gap" in text


def test_page_is_the_same_for_the_same_estimate(grasp: GraspPoseEstimate, page: str) -> None:
    assert render(build_report(grasp), grasp.estimate, "first day", "grasp.toml") == page
    assert len(page) < 400_000


def test_colours_follow_the_page(page: str) -> None:
    figures = "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    for key, colour in plots.PALETTE.items():
        assert colour not in figures, key
        assert f"--{key}:" in page
    # What a figure draws in no colour of the palette would stay black on black.
    assert "#000000" not in figures


def test_general_report_of_any_kind() -> None:
    estimate = made_up(status=Status.UNOBSERVABLE, message="the mass <was> not shown")
    text = render(build_report(estimate), estimate, "<title>")
    assert "<was>" not in text
    page = _Page(text)
    assert "not fully observable" in page.text
    assert "the mass <was> not shown" in page.text
    assert "mass 2.5 0.2 kg" in page.text
    assert "Mass <b>" in page.text
    assert "nothing is known" in page.text
    assert "± 0.057° (asked for: 5.7°)" in page.text
    assert "scale reading 12 0.96 2.2 25.0 %" in page.text
    assert "primal 1.0e-12" in page.text


def test_report_without_covariance() -> None:
    estimate = made_up(
        covariance_source=None, observability=None, status=Status.NOT_CONVERGED, message="it stalled"
    )
    page = _Page(render(build_report(estimate), estimate))
    assert "not converged" in page.text
    assert "it stalled" in page.text


def test_report_replaces_a_file_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("before")
    with pytest.raises(KeyError):
        write_report(made_up(values={}), path)
    assert path.read_text() == "before"
    write_report(made_up(), path)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_results_are_json_without_nan(tmp_path: Path) -> None:
    record = {"a": float("nan"), "b": [1.0, float("inf")], "c": {"d": (2.0, None)}, "e": True}
    assert finite(record) == {"a": None, "b": [1.0, None], "c": {"d": [2.0, None]}, "e": True}
    path = write_result(tmp_path / "new", record, {"x": np.arange(3.0)})
    assert json.loads(path.read_text(encoding="utf-8"))["b"] == [1.0, None]
    with np.load(tmp_path / "new" / "estimate.npz") as arrays:
        np.testing.assert_array_equal(arrays["x"], np.arange(3.0))


@pytest.mark.parametrize(
    "translation", [(1.1, 0.2, 0.1), (0.0, 0.0, -0.08), (0.0, 0.0, 0.0), (-0.02, 0.6, 0.3)]
)
def test_ellipse_is_the_shadow_of_the_ellipsoid(translation: tuple[float, float, float]) -> None:
    """Points drawn from the covariance fall into the drawn ellipse no less often than into the ellipsoid."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3)) * 1e-3
    rotation = so3_exp(np.array([0.3, -1.1, 0.7]))
    made, (axes,) = plots.figure(6.0, 4.0)
    p = np.array(translation)
    magnification, exceeds = grasp_scene.draw_grasp(axes, rotation, p, root @ root.T)
    assert not exceeds
    (ellipse,) = [patch for patch in axes.patches if isinstance(patch, Ellipse)]
    view = grasp_scene._view(rotation, p)
    np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
    draws = rng.normal(size=(4000, 3)) @ root.T
    shown = (p + magnification * draws) @ view.T
    to_data = ellipse.get_patch_transform().inverted().transform(shown)
    inside = np.mean(np.sum(to_data**2, axis=1) <= 1.0)
    # The shadow of the 95 % ellipsoid holds chi-square with 2 degrees of freedom below 7.815: 98.0 %.
    assert abs(inside - 0.980) < 0.01
    # All of it lies in the picture.
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    assert np.all(shown.min(axis=0) > low - 0.1)
    assert np.all(shown.max(axis=0) < high + 0.1)
    assert made.axes == [axes]


def test_rms_per_stretch_keeps_the_power(rng: np.random.Generator) -> None:
    t = np.concatenate([np.arange(0.0, 10.0, 0.001), np.arange(20.0, 30.0, 0.001)])
    values = rng.normal(size=(t.size, 2)) * (1.0, 3.0)
    centres, rms = plots.rms_per_stretch(t, values, 90)
    assert centres.size == 60
    assert not np.any((centres > 10.0) & (centres < 20.0))
    np.testing.assert_allclose(np.mean(rms**2, axis=0), np.mean(values**2, axis=0), rtol=0.02)


def test_lines_break_at_gaps() -> None:
    t = np.array([0.5, 1.0, 1.5, 4.5, 5.0])
    times, values = plots._broken(t, np.arange(5.0)[:, None], 1.0)
    assert np.isnan(times[3])
    assert np.isnan(values[3, 0])
    np.testing.assert_array_equal(np.delete(values, 3), np.arange(5.0))


def test_picture_file(grasp: GraspPoseEstimate, tmp_path: Path) -> None:
    for name, start in (("grasp.png", b"\x89PNG"), ("grasp.pdf", b"%PDF")):
        path = grasp.plot(tmp_path / name)
        assert path.read_bytes().startswith(start)


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (0.00123, "m", "1.2 mm"),
        (1.2345, "m", "1.2 m"),
        (0.9999, "m", "1.0 m"),
        (-0.0007, "s", "-0.70 ms"),
        (np.deg2rad(0.0123), "rad", "0.012°"),
        (np.deg2rad(5.0), "rad/s", "5.0°/s"),
        (0.25, "m/s^2", "0.25 m/s²"),
        (0.0, "kg", "0 kg"),
        (float("inf"), "m", "inf m"),
        (3.0, "", "3.0"),
    ],
)
def test_quantities_for_people(value: float, unit: str, words: str) -> None:
    assert quantity(value, unit).replace("\u00a0", " ") == words


def test_digits() -> None:
    assert [significant(v) for v in (0.0, 123.4, 12.34, 0.0123, 1.5e-9, 4e7)] == [
        "0",
        "123",
        "12",
        "0.012",
        "1.5e-09",
        "4.0e+07",
    ]
    assert [decimals(v) for v in (0.16, 2.4, 33.0, 0.0012, 0.0, float("inf"))] == [2, 1, 0, 4, 6, 6]
