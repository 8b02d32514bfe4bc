from __future__ import annotations

import dataclasses
import importlib.util
import os
import pickle
import sys

import numpy as np
import pytest

from factorgrasp import lie
from factorgrasp.errors import InputError
from factorgrasp.recordings import (
    ImuStream,
    JointStream,
    MotionStream,
    PoseStream,
    column_names,
    read_imu,
    read_joints,
    read_motion,
    read_poses,
    read_stream,
    read_table,
    write_csv,
)

N = 200
T = np.arange(N) * 0.01
UP = np.array([0.0, 0.0, 9.80665])


def smooth(rng, columns=3, scale=1.0):
    walk = np.cumsum(rng.normal(size=(N, columns)), axis=0)
    return scale * walk / np.abs(walk).max()


@pytest.fixture
def poses(rng):
    q = lie.quaternion_exp_wxyz(smooth(rng, 3, 4.0))
    return PoseStream(T, smooth(rng), q)


@pytest.fixture
def imu(rng):
    return ImuStream(T, smooth(rng, 3, 5.0), UP + smooth(rng))


@pytest.fixture
def motion(rng, poses):
    return MotionStream(T, smooth(rng), smooth(rng), UP + smooth(rng), poses.rotation_wxyz)


@pytest.fixture
def joints(rng):
    return JointStream(T, smooth(rng, 7), qd=smooth(rng, 7), qdd=smooth(rng, 7))


@pytest.fixture(params=["poses", "imu", "motion", "joints"])
def stream(request):
    return request.getfixturevalue(request.param)


def message(call):
    with pytest.raises(InputError) as caught:
        call()
    return caught.value


# ------------------------------------------------------------------------------------------ streams


def test_arrays_are_protected_copies(rng):
    position = smooth(rng)
    stream = PoseStream(T, position, np.tile([1.0, 0, 0, 0], (N, 1)))
    position[:] = 0.0
    assert stream.position.any()
    for array in (stream.t, stream.position, stream.rotation_wxyz, stream.rotation, stream.valid):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        stream.t = T


def test_time_and_rate(stream):
    assert len(stream) == N
    assert stream.duration == pytest.approx(1.99)
    assert stream.rate == pytest.approx(100.0)
    assert stream.valid.all()
    assert "200 samples, 1.990 s at 100.0 Hz" in repr(stream)


def test_slice_takes_both_ends_and_shares_memory(stream):
    part = stream.slice(0.5, 1.0)
    assert type(part) is type(stream)
    assert len(part) == 51
    np.testing.assert_array_equal(part.t, stream.t[50:101])
    for field in dataclasses.fields(stream):
        whole, piece = getattr(stream, field.name), getattr(part, field.name)
        if isinstance(whole, np.ndarray):
            assert np.shares_memory(whole, piece)
            assert not piece.flags.writeable
            np.testing.assert_array_equal(piece, whole[50:101])
        else:
            assert piece == whole


def test_slice_may_lie_in_a_gap():
    w = np.ones((N, 3))
    w[50:100] = np.nan
    part = ImuStream(T, w, np.tile(UP, (N, 1))).slice(0.6, 0.8)
    assert not part.valid.any()
    assert part.gaps().count == 1


def test_slice_without_samples(poses):
    for interval in ((5.0, 6.0), (0.501, 0.502), (1.0, 0.5)):
        assert "at least two samples" in message(lambda i=interval: poses.slice(*i)).expected


def test_shifted_moves_the_clock_only(stream):
    later = stream.shifted(-0.25)
    np.testing.assert_allclose(later.t, stream.t - 0.25)
    assert later.duration == pytest.approx(stream.duration)
    assert "finite" in message(lambda: stream.shifted(np.nan)).expected


def test_streams_survive_pickling(stream):
    back = pickle.loads(pickle.dumps(stream))
    for field in dataclasses.fields(stream):
        value = getattr(back, field.name)
        np.testing.assert_array_equal(value, getattr(stream, field.name))
        assert not (isinstance(value, np.ndarray) and value.flags.writeable)


def test_quaternions_are_renormalised_with_continuous_signs(rng):
    phi = smooth(rng, 3, 6.0)
    q = lie.quaternion_exp_wxyz(phi)
    rough = (q * rng.choice([-1.0, 1.0], size=(N, 1)) * rng.uniform(0.995, 1.005, size=(N, 1))).round(4)
    stream = PoseStream(T, np.zeros((N, 3)), rough)
    np.testing.assert_allclose(np.linalg.norm(stream.rotation_wxyz, axis=1), 1.0, atol=1e-15)
    dots = np.einsum("ij,ij->i", stream.rotation_wxyz[1:], stream.rotation_wxyz[:-1])
    assert (dots > 0.0).all()
    assert lie.angle_between(stream.rotation, lie.so3_exp(phi)).max() < 5e-4


def test_half_a_quaternion_is_a_gap():
    q = np.tile([1.0, 0, 0, 0], (N, 1))
    q[7, 2] = np.nan
    stream = PoseStream(T, np.zeros((N, 3)), q)
    assert np.isnan(stream.rotation_wxyz[7]).all()
    np.testing.assert_array_equal(np.flatnonzero(~stream.valid), [7])


def test_gaps_counts_nan_rows_and_missing_stamps():
    keep = np.ones(N, dtype=bool)
    keep[120:150] = False  # 0.3 s missing
    keep[10] = False  # one late sample is no gap
    t = T[keep]
    f = np.tile(UP, (t.size, 1))
    rows = np.isin(np.round(t / 0.01), np.arange(50, 60))
    f[rows] = np.nan  # 0.1 s of NaN
    gaps = ImuStream(t, np.zeros((t.size, 3)), f).gaps()
    assert gaps.count == 2
    assert gaps.seconds == pytest.approx(0.4)
    assert gaps.longest == pytest.approx(0.3)
    np.testing.assert_allclose(gaps.intervals, [(0.49, 0.60), (1.19, 1.50)])


def test_gaps_with_a_limit_are_those_that_resampling_leaves():
    f = np.tile(UP, (N, 1))
    f[50:53] = np.nan
    f[100:110] = np.nan
    stream = ImuStream(T, np.zeros((N, 3)), f)
    assert stream.gaps().count == 2
    assert stream.gaps(max_gap=0.05).count == 1
    assert stream.gaps(max_gap=0.2).count == 0
    message(lambda: stream.gaps(max_gap=0.0))


def test_gaps_at_the_ends():
    f = np.tile(UP, (N, 1))
    f[:20] = np.nan
    f[-5:] = np.nan
    gaps = ImuStream(T, np.zeros((N, 3)), f).gaps()
    assert gaps.count == 2
    assert gaps.seconds == pytest.approx(0.25)
    np.testing.assert_allclose(gaps.intervals, [(0.0, 0.20), (1.94, 1.99)])


def test_no_gaps(stream):
    gaps = stream.gaps()
    assert (gaps.count, gaps.seconds, gaps.longest, gaps.intervals) == (0, 0.0, 0.0, ())


def build(t=T, w=None, f=None, **more):
    n = np.size(t)
    w = np.ones((n, 3)) if w is None else w
    return ImuStream(t, w, np.tile(UP, (n, 1)) if f is None else f, **more)


def changed(array, index, value):
    out = np.array(array, dtype=float)
    out[index] = value
    return out


@pytest.mark.parametrize(
    ("call", "field", "found"),
    [
        (lambda: build([]), "hand.t", "an empty recording"),
        (lambda: build([1.0]), "hand.t", "one sample"),
        (lambda: build(T[:, None]), "hand.t", "shape (200, 1)"),
        (lambda: build(changed(T, 5, np.nan)), "hand.t", "1 not finite, the first in sample 5: nan"),
        (lambda: build(changed(T, 5, np.inf)), "hand.t", "1 not finite, the first in sample 5: inf"),
        (
            lambda: build(changed(T, 5, 0.02)),
            "hand.t",
            "time running backwards in sample 5 (counted from 0): 0.02 after 0.04, 1 time(s) in all",
        ),
        (
            lambda: build(changed(T, 5, 0.04)),
            "hand.t",
            "duplicate stamps: sample 5 (counted from 0) has the time of the one before it, 0.04, 1 time(s) in all",
        ),
        (lambda: build(w=np.ones((N, 4))), "hand.angular_velocity", "shape (200, 4)"),
        (lambda: build(w=np.ones((N - 1, 3))), "hand.angular_velocity", "shape (199, 3)"),
        (lambda: build(w=[["a"] * 3] * N), "hand.angular_velocity", "could not convert"),
        (
            lambda: build(w=changed(np.ones((N, 3)), (7, 1), -np.inf)),
            "hand.angular_velocity",
            "-inf in sample 7 (counted from 0), column wy, 1 in all",
        ),
        (
            lambda: build(f=changed(np.tile(UP, (N, 1)), np.s_[:, 2], np.nan)),
            "hand.specific_force",
            "nothing but NaN in column az",
        ),
        (
            lambda: build(w=60.0 * np.ones((N, 3))),
            "hand.angular_velocity",
            "degrees per second suspected (103.9 deg/s",
        ),
        (
            lambda: build(f=np.tile(UP / 9.80665, (N, 1))),
            "hand.specific_force",
            "g units suspected (1 g = 9.807 m/s^2)",
        ),
        (lambda: build(f=0.01 * np.ones((N, 3))), "hand.specific_force", "gravity seems to be removed"),
        (
            lambda: build(f=np.tile(100.0 * UP, (N, 1))),
            "hand.specific_force",
            "milli-g or raw counts suspected",
        ),
        (lambda: build(T * 1000.0), "hand.t", "milliseconds or finer suspected"),
        (lambda: build(T * 1000.0, name="glove"), "glove.t", "milliseconds or finer suspected"),
    ],
)
def test_imu_that_cannot_be_used(call, field, found):
    error = message(call)
    assert error.field == field
    assert found in error.found


def test_plausibility_can_be_switched_off():
    stream = build(T * 1000.0, w=100.0 * np.ones((N, 3)), f=0.1 * np.ones((N, 3)), check_units=False)
    assert stream.slice(0.0, 1000.0).shifted(1.0).check_units is False


def test_a_slice_at_rest_is_not_questioned_again():
    f = np.tile(UP, (N, 1))
    f[:20] /= 9.80665  # the whole has the right median, the part has not
    assert len(build(f=f).slice(0.0, 0.1)) == 11


UNIT = np.tile([1.0, 0, 0, 0], (N, 1))


def test_a_few_short_quaternions_are_gaps_and_many_are_an_error():
    few, many = UNIT.copy(), UNIT.copy()
    few[[9, 10]] *= 0.6
    many[9:19] *= 0.6
    with pytest.warns(UserWarning, match=r"2 quaternion\(s\) shorter than 1"):
        stream = PoseStream(T, np.zeros((N, 3)), few)
    np.testing.assert_array_equal(np.flatnonzero(~stream.valid), [9, 10])
    assert "10 such row(s)" in message(lambda: PoseStream(T, np.zeros((N, 3)), many)).found


@pytest.mark.parametrize(
    ("call", "field", "found"),
    [
        (
            lambda: PoseStream(T, np.zeros((N, 3)), changed(UNIT, 9, [1.1, 0.1, 0.2, 0.0])),
            "robot.rotation_wxyz",
            "norm 1.1225 in sample 9 (counted from 0), 1 such row(s) in all",
        ),
        (lambda: PoseStream(T, np.zeros((N, 3)), np.zeros((N, 3))), "robot.rotation_wxyz", "shape (200, 3)"),
        (
            lambda: PoseStream(T, 500.0 * np.outer(T, [1, 0, 0]), UNIT),
            "robot.position",
            "millimetres suspected (995 mm = 0.995 m)",
        ),
        (lambda: JointStream(T, np.full((N, 2), 90.0)), "robot.q", "degrees suspected (90 deg = 1.571 rad)"),
        (lambda: JointStream(T, np.zeros(N)), "robot.q", "shape (200,)"),
        (lambda: JointStream(T, np.zeros((N, 2)), names=("a", "a")), "robot.names", "('a', 'a')"),
        (lambda: JointStream(T, np.zeros((N, 2)), qd=np.zeros((N, 3))), "robot.qd", "shape (200, 3)"),
        (
            lambda: MotionStream(T, np.zeros((N, 3)), np.zeros((N, 2)), np.tile(UP, (N, 1))),
            "robot.angular_acceleration",
            "shape (200, 2)",
        ),
    ],
)
def test_other_streams_that_cannot_be_used(call, field, found):
    error = message(call)
    assert error.field == field
    assert found in error.found


def test_motion_from_accelerations_reads_like_an_accelerometer(rng):
    q = lie.quaternion_exp_wxyz(smooth(rng, 3, 3.0))
    a_world = smooth(rng)
    R = lie.quaternion_wxyz_to_matrix(q)
    a_body = np.einsum("nij,ni->nj", R, a_world)
    gravity = np.array([0.3, -0.1, -9.7])
    stream = MotionStream.from_accelerations(T, smooth(rng), smooth(rng), a_body, q, gravity)
    expected = np.einsum("nij,ni->nj", R, a_world - gravity)
    np.testing.assert_allclose(stream.specific_force, expected, atol=1e-13)
    # At rest and upright it reads 9.8 upwards.
    rest = MotionStream.from_accelerations(T, np.zeros((N, 3)), np.zeros((N, 3)), np.zeros((N, 3)), UNIT)
    np.testing.assert_array_equal(rest.specific_force, np.tile(UP, (N, 1)))
    assert (
        "gravity"
        in message(lambda: MotionStream.from_accelerations(T, a_body, a_body, a_body, q, [0.0, 9.8])).field
    )


# ------------------------------------------------------------------------------------------ files

READERS = {PoseStream: read_poses, ImuStream: read_imu, MotionStream: read_motion, JointStream: read_joints}


def same(a, b):
    for field in dataclasses.fields(a):
        if field.name not in ("name", "check_units"):
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_csv_round_trip_is_exact(stream, tmp_path):
    path = tmp_path / "recording.csv"
    write_csv(path, stream)
    for back in (READERS[type(stream)](path), read_stream(path)):
        assert type(back) is type(stream)
        same(back, stream)
    assert os.listdir(tmp_path) == ["recording.csv"]


def test_gaps_survive_the_round_trip(rng, tmp_path):
    position = smooth(rng)
    position[20:30] = np.nan
    q = UNIT.copy()
    q[25:40] = np.nan
    before = PoseStream(T, position, q)
    write_csv(tmp_path / "p.csv", before)
    after = read_poses(tmp_path / "p.csv")
    same(after, before)
    assert after.gaps() == before.gaps()
    assert after.gaps().count == 1


def test_motion_without_rotation_and_joints_without_rates(rng, tmp_path):
    motion = MotionStream(T, smooth(rng), smooth(rng), UP + smooth(rng))
    write_csv(tmp_path / "m.csv", motion)
    assert read_motion(tmp_path / "m.csv").rotation_wxyz is None
    joints = JointStream(T, smooth(rng, 2))
    write_csv(tmp_path / "j.csv", joints)
    back = read_stream(tmp_path / "j.csv")
    assert back.qd is None
    assert back.names == ("q1", "q2")


def test_a_failed_write_leaves_the_old_file(stream, tmp_path, monkeypatch):
    path = tmp_path / "r.csv"
    path.write_text("old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        write_csv(path, stream)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["r.csv"]


def test_writing_needs_a_folder_and_a_stream(stream, tmp_path):
    assert "no folder" in message(lambda: write_csv(tmp_path / "no" / "r.csv", stream)).found
    assert "dict" in message(lambda: write_csv(tmp_path / "r.csv", {})).found


IMU_ROWS = "0.00,1,2,3,0,0,9.8\n0.01,1,2,3.5,0,0,9.9\n0.02,1,2,4,0,0,9.7\n"
IMU_HEADER = "t,wx,wy,wz,ax,ay,az\n"


def imu_file(tmp_path, text, name="imu.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    "text",
    [
        IMU_HEADER + IMU_ROWS,
        "\ufeff" + IMU_HEADER + IMU_ROWS,
        (IMU_HEADER + IMU_ROWS).replace("\n", "\r\n"),
        (IMU_HEADER + IMU_ROWS).replace("\n", "\r"),
        (IMU_HEADER + IMU_ROWS).replace(",", " , "),
        (IMU_HEADER + IMU_ROWS).replace(",", ";"),
        (IMU_HEADER + IMU_ROWS).replace(",", "\t"),
        (IMU_HEADER + IMU_ROWS).rstrip("\n"),
        "# made by hand\n\n" + IMU_HEADER + "# here it starts\n" + IMU_ROWS + "\n# the end\n\n",
        "#" + IMU_HEADER + IMU_ROWS,
        (IMU_HEADER + IMU_ROWS).replace("0.01,", '"0.01",'),
        (IMU_HEADER + IMU_ROWS).replace("\n", ",\n"),
        (IMU_HEADER + IMU_ROWS).replace("\n", ",note\n"),
        "seq (raw) [x] y," + IMU_HEADER + "".join(f"{k},{row}\n" for k, row in enumerate(IMU_ROWS.split())),
        "ax,t,ay,az,wx,wy,wz\n0,0.00,0,9.8,1,2,3\n0,0.01,0,9.9,1,2,3.5\n0,0.02,0,9.7,1,2,4\n",
    ],
)
def test_dialects_of_csv(tmp_path, text):
    stream = read_imu(imu_file(tmp_path, text))
    np.testing.assert_array_equal(stream.t, [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(stream.angular_velocity, [[1, 2, 3], [1, 2, 3.5], [1, 2, 4]])
    np.testing.assert_array_equal(stream.specific_force, [[0, 0, 9.8], [0, 0, 9.9], [0, 0, 9.7]])


@pytest.mark.parametrize("lost", ["", "nan", "NaN", "  ", " nan "])
@pytest.mark.parametrize("delimiter", [",", "\t"])
def test_empty_fields_are_gaps(tmp_path, lost, delimiter):
    rows = f"0.00,1,2,3,0,0,9.8\n0.01,1,{lost},3.5,0,0,{lost}\n0.02,1,2,4,0,0,9.7\n"
    stream = read_imu(imu_file(tmp_path, (IMU_HEADER + rows).replace(",", delimiter)))
    np.testing.assert_array_equal(stream.valid, [True, False, True])
    np.testing.assert_array_equal(np.isnan(stream.angular_velocity[1]), [False, True, False])
    np.testing.assert_array_equal(np.isnan(stream.specific_force[1]), [False, False, True])


def test_units_are_converted_at_the_door(tmp_path):
    header = "t [ns],wx [deg/s],wy [°/s],wz (rad s^-1),ax [g],ay [mg],az [m/s^2]\n"
    rows = "0,180,90,1,1,500,9\n10000000,180,90,1,1,500,9\n20000000,180,90,1,1,500,9\n"
    for encoding in ("utf-8", "cp1252", "utf-16"):
        stream = read_imu(imu_file(tmp_path, header + rows, encoding=encoding))
        np.testing.assert_allclose(stream.t, [0.0, 0.01, 0.02], rtol=1e-15)
        np.testing.assert_allclose(stream.angular_velocity[0], [np.pi, np.pi / 2, 1.0], rtol=1e-15)
        np.testing.assert_allclose(stream.specific_force[0], [9.80665, 4.903325, 9.0], rtol=1e-15)


def test_units_of_poses_and_joints(tmp_path):
    header = "t [ms],px [mm],py [cm],pz [m],qw [],qx [-],qy,qz [1]\n"
    path = imu_file(tmp_path, header + "0,1,1,1,1,0,0,0\n10,1000,100,1,1,0,0,0\n")
    stream = read_poses(path)
    np.testing.assert_allclose(stream.position, [[0.001, 0.01, 1.0], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(stream.t, [0.0, 0.01])
    path = imu_file(tmp_path, "t,q1 [deg],q2 [mm],qd1 [deg/s],qd2 [m/s]\n0,180,5,90,1\n0.1,180,5,90,1\n")
    joints = read_joints(path)
    np.testing.assert_allclose(joints.q[0], [np.pi, 0.005])
    np.testing.assert_allclose(joints.qd[0], [np.pi / 2, 1.0])


@pytest.mark.parametrize(
    ("text", "field", "found"),
    [
        ("", "", "an empty file"),
        ("\n\n# nothing\n", "", "an empty file"),
        (IMU_HEADER, "", "a header only"),
        (IMU_HEADER + "\n  \n# none\n", "", "a header only"),
        (IMU_ROWS, ": header", "0.00,1,2,3,0,0,9.8"),
        (IMU_HEADER + "0,1,2,3,0,0,9.8\n", ": hand.t", "one sample"),
        (
            "t,wx,wy,gz,ax,ay,az\n" + IMU_ROWS,
            ": columns",
            "wz missing; the file has t, wx, wy, gz, ax, ay, az",
        ),
        ("t,wx,wx,wy,wz,ax,ay,az\n" + IMU_ROWS, ": columns", "2 of them"),
        (IMU_HEADER + IMU_ROWS + "0.03,1,abc,3,0,0,9.8\n", ": line 5, column wy", "'abc'"),
        (
            "# a\n" + IMU_HEADER + "# b\n" + IMU_ROWS + "0.03,1,2 3,3,0,0,9.8\n",
            ": line 7, column wy",
            "'2 3'",
        ),
        (IMU_HEADER + IMU_ROWS + "0.03,1,2,3,0,0\n", ": line 5", "6 fields"),
        (IMU_HEADER + IMU_ROWS + "0.03,1,2,3,0,0,9.8,1\n", ": line 5", "8 fields"),
        (
            IMU_HEADER.replace(",", ";") + IMU_ROWS.replace(",", ";").replace(".", ","),
            ": line 2, column t",
            "'0,00'",
        ),
        (
            IMU_HEADER + IMU_ROWS + ",1,2,3,0,0,9.8\n",
            ": column t",
            "1 row(s) without one, the first in line 5",
        ),
        ("#\n" + IMU_HEADER + "nan,1,2,3,0,0,9.8\n" + IMU_ROWS, ": column t", "the first in line 3"),
        (IMU_HEADER + IMU_ROWS + "0.01,1,2,3,0,0,9.8\n", ": hand.t", "time running backwards in sample 3"),
        (IMU_HEADER + IMU_ROWS + "0.02,1,2,3,0,0,9.8\n", ": hand.t", "duplicate stamps: sample 3"),
        (IMU_HEADER + IMU_ROWS + "0.03,1,inf,3,0,0,9.8\n", ": hand.angular_velocity", "inf in sample 3"),
        (IMU_HEADER.replace("wx", "wx [furlong]") + IMU_ROWS, ": column wx", "[furlong]"),
        (IMU_HEADER.replace("wx", "wx [mm]") + IMU_ROWS, ": column wx", "[mm], which is m"),
        (IMU_HEADER.replace("ax", "ax [deg/s]") + IMU_ROWS, ": column ax", "[deg/s], which is rad/s"),
        ("\0\1\2\3" * 20, "", "a binary file"),
    ],
)
def test_csv_that_cannot_be_used(tmp_path, text, field, found):
    path = imu_file(tmp_path, text)
    error = message(lambda: read_imu(path))
    assert error.field == f"{path}{field}"
    assert found in error.found


def test_unknown_unit_lists_those_that_fit(tmp_path):
    path = imu_file(tmp_path, IMU_HEADER.replace("wx", "wx [turns]") + IMU_ROWS)
    expected = message(lambda: read_imu(path)).expected
    assert "deg/s" in expected
    assert "mm" not in expected


def test_missing_files_and_folders(tmp_path):
    assert message(lambda: read_imu(tmp_path / "no.csv")).found == "no such file"
    assert message(lambda: read_stream(tmp_path / "no.npz")).found == "no such file"
    assert message(lambda: read_table(tmp_path)).found == "a folder"


def test_read_stream_knows_what_it_has(tmp_path):
    both = imu_file(tmp_path, "t,px,py,pz,qw,qx,qy,qz,wx,wy,wz,ax,ay,az\n")
    error = message(lambda: read_stream(both))
    assert error.found == "those of poses and imu"
    assert error.hint == "Call read_poses or read_imu"
    neither = imu_file(tmp_path, "time,x\n")
    assert message(lambda: read_stream(neither)).found == "time, x"


def test_read_stream_names_the_recording(tmp_path):
    path = imu_file(tmp_path, IMU_HEADER + IMU_ROWS)
    assert read_stream(path).name == "hand"
    assert read_stream(path, name="tool").name == "tool"
    degrees = imu_file(tmp_path, IMU_HEADER + IMU_ROWS.replace(",2,", ",200,"))
    assert "degrees per second suspected" in message(lambda: read_stream(degrees)).found
    assert read_stream(degrees, check_units=False).angular_velocity[0, 1] == 200.0


def test_joints_must_be_complete(tmp_path):
    path = imu_file(tmp_path, "t,q1,q3\n0,1,1\n0.1,1,1\n")
    assert "q2 missing" in message(lambda: read_joints(path)).found
    path = imu_file(tmp_path, "t,q1,q2,qd1\n0,1,1,1\n0.1,1,1,1\n")
    assert message(lambda: read_joints(path)).field.endswith("robot.qd")
    path = imu_file(tmp_path, "t,x\n0,1\n0.1,1\n")
    assert "q1 missing" in message(lambda: read_joints(path)).found


def test_read_table_of_everything(tmp_path):
    path = imu_file(tmp_path, "t [ms],fx [kN],mass,hz [N mm]\n0,1,2,5\n1,,3,5\n")
    table = read_table(path)
    assert list(table) == ["t", "fx", "mass", "hz"]
    np.testing.assert_allclose(table["fx"], [1000.0, np.nan])
    np.testing.assert_allclose(table["hz"], 0.005)
    np.testing.assert_array_equal(table["mass"], [2.0, 3.0])
    assert list(read_table(path, ["t"], ["mass", "absent"])) == ["t", "mass"]
    assert column_names(path) == ("t", "fx", "mass", "hz")


def test_repair_says_what_it_did(tmp_path, recwarn):
    rows = "0,0,0,0,1,0,0,0\n0.1,0,0,0,0.5,0,0,0\n0.1,1,0,0,1,0,0,0\n0.2,0,0,0,1,0,0,0\n"
    path = imu_file(tmp_path, "t,px,py,pz,qw,qx,qy,qz\n" + rows)
    assert "duplicate stamps" in message(lambda: read_poses(path)).found
    stream = read_poses(path, repair=True)
    np.testing.assert_array_equal(stream.t, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(stream.valid, [True, False, True])
    np.testing.assert_array_equal(stream.position, 0.0)
    assert len(recwarn) == 1
    text = str(recwarn.pop().message)
    assert text.endswith(
        "dropped 1 row(s) with the stamp of the row before and made gaps of 1 quaternion(s) whose norm is not 1"
    )
    clean = imu_file(tmp_path, IMU_HEADER + IMU_ROWS)
    same(read_imu(clean, repair=True), read_imu(clean))
    assert len(recwarn) == 0
    backwards = imu_file(tmp_path, IMU_HEADER + IMU_ROWS + "0.01,1,2,3,0,0,9.8\n")
    assert "backwards" in message(lambda: read_imu(backwards, repair=True)).found


# ------------------------------------------------------------------------------------------ NPZ and Parquet


def imu_columns(imu):
    return {
        "t": imu.t,
        **dict(zip(("wx", "wy", "wz"), imu.angular_velocity.T, strict=True)),
        **dict(zip(("ax", "ay", "az"), imu.specific_force.T, strict=True)),
    }


def test_npz(imu, tmp_path):
    path = tmp_path / "imu.npz"
    np.savez(path, **imu_columns(imu), anything=np.eye(3))
    same(read_stream(path), imu)
    columns = imu_columns(imu)
    columns["t [ns]"] = (columns.pop("t") * 1e9).astype(np.int64)
    np.savez(path, **columns)
    np.testing.assert_allclose(read_imu(path).t, imu.t, atol=1e-9)


def test_npz_that_cannot_be_used(imu, tmp_path):
    path = tmp_path / "imu.npz"
    for change, found in (
        ({"wx": imu.t[:-1]}, "wx: 199"),
        ({"wx": imu.angular_velocity}, "float64 of shape (200, 3)"),
        ({"wx": np.array(["a"] * N)}, "<U1 of shape (200,)"),
        ({"wx": np.array([None] * N)}, "Object arrays cannot be loaded"),
        ({"t": changed(T, 3, np.nan)}, "row 3 (counted from 0)"),
    ):
        np.savez(path, **(imu_columns(imu) | change))
        assert found in message(lambda: read_imu(path)).found
    np.savez(path, **{name: [] for name in imu_columns(imu)})
    assert message(lambda: read_imu(path)).found == "columns without rows"
    np.savez(path, t=T)
    assert message(lambda: read_imu(path)).found == "wx, wy, wz, ax, ay, az missing; the file has t"
    path.write_bytes(b"PK broken")
    assert message(lambda: read_imu(path)).field == str(path)
    np.save(tmp_path / "one.npy", T)
    (tmp_path / "one.npy").replace(path)
    assert message(lambda: read_imu(path)).found == "a single array"


@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed")
def test_parquet(imu, tmp_path):
    import pyarrow
    import pyarrow.parquet as parquet

    path = tmp_path / "imu.parquet"
    columns = imu_columns(imu)
    columns["wx [deg/s]"] = np.rad2deg(columns.pop("wx"))
    parquet.write_table(pyarrow.table({**columns, "label": ["x"] * N}), path)
    back = read_stream(path)
    np.testing.assert_allclose(back.angular_velocity, imu.angular_velocity, atol=1e-14)
    np.testing.assert_array_equal(back.specific_force, imu.specific_force)
    # A null is a gap, also in a column of integers.
    gap = imu_columns(imu) | {"ax": [None if k == 4 else 1 for k in range(N)]}
    parquet.write_table(pyarrow.table(gap), path)
    np.testing.assert_array_equal(np.flatnonzero(~read_imu(path).valid), [4])
    path.write_bytes(b"no parquet at all")
    assert message(lambda: read_imu(path)).expected == "a Parquet file"


def test_parquet_without_pyarrow_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    path = tmp_path / "imu.parquet"
    path.write_bytes(b"PAR1")
    assert "pip install" in message(lambda: read_imu(path)).hint


# ------------------------------------------------------------------------------------------ real data


def test_real_robot_and_imu_in_one_file(dataset):
    path = dataset("abb_imu_robot/MPU9150_eV50p_Sequencia1.csv")
    poses, imu = read_poses(path), read_imu(path)
    assert len(poses) == len(imu) > 1000
    assert poses.duration == imu.duration
    assert "poses and imu" in message(lambda: read_stream(path)).found
    assert np.median(np.linalg.norm(imu.specific_force, axis=1)) == pytest.approx(9.8, abs=0.3)


def test_real_camera_and_robot_poses(dataset):
    folder = dataset("handeye_real")
    for path in sorted(folder.glob("*.csv")):
        if path.name.startswith("vicon"):
            continue
        stream = read_stream(path)
        assert isinstance(stream, PoseStream)
        assert stream.valid.all()
        np.testing.assert_allclose(np.linalg.norm(stream.rotation_wxyz, axis=1), 1.0, atol=1e-14)


def test_real_faults_are_found_and_repaired_on_request_only(dataset):
    path = dataset("handeye_real/vicon_T_primesense_body.csv")
    assert "duplicate stamps: sample 1161 (counted from 0)" in message(lambda: read_stream(path)).found
    with pytest.warns(UserWarning, match=r"dropped 5 row\(s\) with the stamp of the row before$"):
        assert len(read_stream(path, repair=True)) == 7088
    # Its authors interpolated quaternions across changes of sign.
    path = dataset("abb_imu_robot/MPU9150_V_800_Sequencia1.csv")
    with pytest.warns(
        UserWarning, match=r"21 quaternion\(s\) shorter than 1 \(down to 0\.\d+\).*taken as gaps"
    ):
        assert (~read_poses(path).valid).sum() == 21
    with pytest.warns(UserWarning, match=r"made gaps of 21 quaternion\(s\) whose norm is not 1$"):
        poses = read_poses(path, repair=True)
    assert (~poses.valid).sum() == 21


def test_real_drone_in_nanoseconds(dataset):
    path = dataset("euroc_v102/imu0_data.csv")
    # Its columns have names of their own, with units that are understood, in a header that is a comment.
    names = column_names(path)
    assert names[:2] == ("timestamp", "w_RS_S_x")
    table = read_table(path)
    steps = np.diff(table["timestamp"])
    assert np.median(steps) == pytest.approx(0.005, rel=1e-4)
    t = table["timestamp"] - table["timestamp"][0]
    imu = ImuStream(t, *(np.column_stack([table[f"{k}_RS_S_{a}"] for a in "xyz"]) for k in "wa"))
    assert imu.rate == pytest.approx(200.0, rel=1e-3)


def test_real_motion_capture_gaps(dataset):
    data = np.load(dataset("broad/21_undisturbed_fast_combined.npz"))
    t = np.arange(len(data["opt_pos"])) / float(data["fs"])
    stream = PoseStream(t, data["opt_pos"], data["opt_quat"])
    gaps = stream.gaps()
    assert gaps.count == 2
    assert gaps.seconds == pytest.approx(int((~stream.valid).sum()) / float(data["fs"]))
    assert len(ImuStream(t, data["imu_gyr"], data["imu_acc"])) == len(stream)
