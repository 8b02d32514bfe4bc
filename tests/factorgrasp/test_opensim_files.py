from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factorgrasp.errors import InputError
from factorgrasp.recordings.forces import (
    ForceRecording,
    read_external_loads,
    read_force_table,
    read_opensim_forces,
    read_wrench_table,
)
from factorgrasp.recordings.links import read_link_coordinates, read_link_forces
from factorgrasp.recordings.opensim import read_coordinates, read_storage, read_trc

MOT = "Coordinates\nversion=1\nnRows=2\nnColumns=4\ninDegrees={degrees}\n\nendheader\n" + (
    "time\thip\tpelvis_tx\tslide\n0.0\t90\t0.5\t2\n0.1\t-45\tnan\t3\n"
)
TRC = (
    "PathFileType\t4\t(X/Y/Z)\ta.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "60.00\t60.00\t3\t2\t{unit}\t60.00\t1\t3\n"
    "Frame#\tTime\tR.ASIS\t\t\tSternum\t\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\t\n\n"
    "1\t0.0\t1000\t200\t-30\t1\t2\t3\t\n"
    "2\t0.1\t\t\t\t4\t5\t6\n"
    "3\t0.2\t7\t\t9\n"
)
LOADS = """<OpenSimDocument Version="30000"><ExternalLoads name="x"><objects>
<ExternalForce name="right"><applied_to_body>calcn_r</applied_to_body>
<force_expressed_in_body>{frame}</force_expressed_in_body><point_expressed_in_body>ground</point_expressed_in_body>
<force_identifier>f_v</force_identifier><point_identifier>f_p</point_identifier>
<torque_identifier>{torque}</torque_identifier></ExternalForce>
<ExternalForce name="off"><isDisabled>true</isDisabled></ExternalForce>
</objects><datafile>somewhere\\else\\grf.mot</datafile></ExternalLoads></OpenSimDocument>"""
GRF = "grf\nnRows=2\nnColumns=10\nendheader\ntime f_vx f_vy f_vz f_px f_py f_pz f_mx f_my f_mz\n" + (
    "0 1 700 2 0.1 0 0.2 0 3 0\n0.01 0 0 0 0 0 0 0 0 0\n"
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    def written(name: str, text: str) -> Path:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return written


def test_degrees_are_converted_where_the_header_says_so(write: Callable[[str, str], Path]) -> None:
    table = read_coordinates(write("a.mot", MOT.format(degrees="yes")), translations=("slide",))
    assert table.names == ("hip", "pelvis_tx", "slide")
    assert table.translations == ("pelvis_tx", "slide")
    np.testing.assert_allclose(table.values[:, 0], [np.pi / 2, -np.pi / 4])
    np.testing.assert_array_equal(table.values[:, 1], [0.5, np.nan])
    np.testing.assert_array_equal(table.values[:, 2], [2.0, 3.0])


def test_degrees_that_the_header_calls_radians_are_noticed(write: Callable[[str, str], Path]) -> None:
    path = write("a.mot", MOT.format(degrees="no"))
    with pytest.raises(InputError, match="Degrees that the header calls radians"):
        read_coordinates(path)
    path = write("b.mot", MOT.replace("inDegrees={degrees}\n", ""))
    with pytest.raises(InputError, match="inDegrees: expected yes or no"):
        read_coordinates(path)
    assert read_coordinates(path, in_degrees=True).values[0, 0] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("endheader", "end"), "endheader"),
        (("nRows=2", "nRows=3"), "3 rows.*found 2.*complete"),
        (("nColumns=4", "nColumns=5"), "5 columns"),
        (("time\thip", "frame\thip"), "'time'"),
        (("\t90\t", "\tninety\t"), "line 9, column 2: expected a number; found 'ninety'"),
        (("0.1\t-45", "0.0\t-45"), "duplicate stamps"),
        (("slide\n", "hip\n"), "hip more than once"),
        (("-45\tnan", "-45"), "line 10: expected 4 fields; found 3"),
        (("=yes", "=maybe"), "inDegrees: expected yes or no"),
    ],
)
def test_what_is_wrong_with_a_storage_is_named(
    write: Callable[[str, str], Path], change: tuple[str, str], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read_storage(write("a.mot", MOT.format(degrees="yes").replace(*change)))


def test_markers_come_in_metres_with_gaps(write: Callable[[str, str], Path]) -> None:
    markers = read_trc(write("a.trc", TRC.format(unit="mm")))
    assert markers.names == ("R.ASIS", "Sternum")
    assert markers.rate == 60.0
    np.testing.assert_allclose(markers.position[0], [[1.0, 0.2, -0.03], [0.001, 0.002, 0.003]])
    assert np.isnan(markers.position[1, 0]).all()
    np.testing.assert_allclose(markers.position[1, 1], [0.004, 0.005, 0.006])
    # Half a marker is none, and a line may end early.
    assert np.isnan(markers.position[2]).all()
    assert read_trc(write("b.trc", TRC.format(unit="m"))).position[0, 0, 0] == 1000.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("\tmm\t", "\tinch\t"), "Units: expected a unit"),
        (("\t2\tmm", "\t3\tmm"), "the names of 3 markers; found 2"),
        (("60.00\t3\t", "60.00\t4\t"), "4 frames"),
        (("PathFileType", "Path"), "PathFileType"),
    ],
)
def test_what_is_wrong_with_a_marker_file_is_named(
    write: Callable[[str, str], Path], change: tuple[str, str], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read_trc(write("a.trc", TRC.format(unit="mm").replace(*change)))


def test_external_loads_find_their_data(write: Callable[[str, str], Path]) -> None:
    write("grf.mot", GRF)
    (force,) = read_opensim_forces(write("loads.xml", LOADS.format(frame="ground", torque="f_m")))
    assert (force.link, force.name, len(force)) == ("calcn_r", "right", 2)
    # A vertical force (y up) 0.1 m in front of and 0.2 m beside the origin, and a free moment.
    np.testing.assert_allclose(force.wrench_about([0, 0, 0])[0], [1, 700, 2, -140.0, 3.0 + 0.2 - 0.2, 70.0])
    np.testing.assert_array_equal(force.wrench_about([5, 5, 5])[1], np.zeros(6))


def test_external_loads_that_cannot_be_used(write: Callable[[str, str], Path]) -> None:
    write("grf.mot", GRF)
    with pytest.raises(InputError, match="right, force_expressed_in_body: expected ground; found calcn_r"):
        read_external_loads(write("a.xml", LOADS.format(frame="calcn_r", torque="f_m")))
    with pytest.raises(InputError, match=r"grf.mot: columns.*q_x, q_y, q_z missing"):
        read_opensim_forces(write("b.xml", LOADS.format(frame="ground", torque="q_")))
    with pytest.raises(InputError, match="an XML file"):
        read_external_loads(write("c.xml", "<OpenSim"))
    with pytest.raises(InputError, match="an element ExternalLoads"):
        read_external_loads(write("d.xml", "<OpenSim/>"))


def test_force_tables(write: Callable[[str, str], Path]) -> None:
    path = write(
        "f.csv", "t,fx,fy,fz,px [mm],py [mm],pz [mm],mx,my,mz\n0,0,0,700,100,0,0,0,0,0\n1,,,,,,,,,\n"
    )
    force = read_force_table(path, "LeftFoot")
    np.testing.assert_allclose(force.wrench_about([0, 0, 0])[0], [0, 0, 700, 0, -70, 0])
    assert np.isnan(force.wrench_about([0, 0, 0])[1]).all()
    t, wrench = read_wrench_table(write("w.csv", "t,fx,fy,fz,mx,my,mz\n0,1,2,3,4,5,6\n1,1,2,3,4,5,6\n"))
    assert t.size == 2
    np.testing.assert_array_equal(wrench[0], [1, 2, 3, 4, 5, 6])
    with pytest.raises(InputError, match="pz missing"):
        read_force_table(write("g.csv", "t,fx,fy,fz,px,py\n0,0,0,1,0,0\n1,0,0,1,0,0\n"), "LeftFoot")
    with pytest.raises(InputError, match=r"shape \(2, 3\) in N"):
        ForceRecording(np.arange(2.0), np.zeros((3, 3)), np.zeros((2, 3)), np.zeros((2, 3)), "foot")


def test_walking_recording(dataset: Callable[[str], Path]) -> None:
    folder = dataset("opensim_walk_gait2354")
    table = read_coordinates(folder / "subject01_walk1_ik.mot")
    assert table.names[0] == "pelvis_tilt"
    assert table.values[0, 0] == pytest.approx(np.radians(4.84455933))
    assert table.values[0, 4] == pytest.approx(1.04559875)
    markers = read_trc(folder / "subject01_walk1.trc")
    assert markers.position.shape == (151, 41, 3)
    np.testing.assert_allclose(markers.position[0, 0], [0.61724762, 1.05527502, 0.17078198])
    right, left = read_opensim_forces(folder / "subject01_walk1_grf.xml")
    assert (right.link, left.link, len(right)) == ("calcn_r", "calcn_l", 1501)
    # The archive's forces are those of the file at its times.
    archived = read_link_forces(folder / "links_walk.npz")
    for mine, theirs in zip((right, left), archived, strict=True):
        at = np.column_stack([np.interp(theirs.t, mine.t, mine.force[:, k]) for k in range(3)])
        assert np.sqrt(np.mean((at - theirs.force) ** 2)) < 15.0
    coordinates, rates, _ = read_link_coordinates(folder / "links_walk.npz")
    assert coordinates.names == table.names
    middle = np.interp(coordinates.t[20], table.t, table.values[:, 6])
    assert coordinates.values[20, 6] == pytest.approx(middle, abs=0.02)
    assert rates.shape == coordinates.values.shape


def test_squat_recording(dataset: Callable[[str], Path]) -> None:
    folder = dataset("opencap_squat")
    forces = read_opensim_forces(folder / "ext_fixed.xml")
    assert [force.link for force in forces] == ["calcn_r", "calcn_l", "calcn_r"]
    weight = np.mean(sum(force.force[:, 1] for force in forces))
    assert 55.0 < weight / 9.80665 < 70.0
    assert len(read_link_forces(folder / "links_squat.npz")) == 3
    with pytest.raises(InputError, match="the fields t, grf, grf_body"):
        read_link_forces(dataset("opensim_walk_gait2354") / "ANSWERS_links_walk.npz")
