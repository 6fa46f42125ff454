"""Trajectories in CSV, Parquet and TUM files: exact columns, exact round trips, and what is read leniently."""

import json
import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from psotrack.trajectories import Status, Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.columns import ALL_COLUMNS
from psotrack.trajectories.tum import write_tum

SUFFIXES = (".csv", ".parquet")
HEADER = "frame,time_s,drone,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s,fitness,num_cameras,status"


def two_drones(dtype=np.float32):
    """Three frames of two drones; the second drone is lost in the last frame, with an unknown position."""
    position_m = np.array([[[0.1, -2, 1.5], [3, 4, 1]]] * 3, dtype)
    position_m[2, 1] = np.nan
    return Trajectories(
        frame=np.arange(3),
        time_s=np.arange(3) / 25,
        drones=("dron1", "dron2"),
        position_m=position_m,
        velocity_m_s=np.full((3, 2, 3), 0.25, dtype),
        fitness=np.full((3, 2), 0.7, dtype),
        num_cameras=np.full((3, 2), 8),
        status=np.array([[Status.TRACKED] * 2, [Status.COASTING] * 2, [Status.TRACKED, Status.LOST]]),
    )


# --- there and back


@st.composite
def drawn_arguments(draw, dtype):
    # The strategy draws arguments, not a `Trajectories`: the type checker samples array elements at random,
    # and a hypothesis strategy must be deterministic.
    frames, drones = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    names = st.text("ab 1,;\"'#é", min_size=1, max_size=5).map(str.strip).filter(bool)
    # Larger numbers are refused.
    numbers = st.floats(allow_infinity=False, width=32 if dtype == np.float32 else 64)
    numbers = numbers.map(
        lambda value: math.copysign(min(abs(value), 1e60), value) if value == value else value
    )
    known = numbers.filter(np.isfinite)

    def floats(*parts):
        values = draw(hnp.arrays(dtype, (frames, drones, *parts), elements=numbers))
        # At least one number is not NaN: an array of NaN only is read back as None.
        values[0, 0] = draw(known)
        return values

    def covariance(root):
        # Products of larger numbers overflow in float32.
        root = np.clip(root, -1e18, 1e18).astype(np.float64)
        product = np.einsum("...ij,...kj->...ik", root, root)
        return np.where(np.tri(3, dtype=bool), np.swapaxes(product, -1, -2), product).astype(dtype)

    def integers(top):
        return draw(hnp.arrays(np.int64, (frames, drones), elements=st.integers(0, top)))

    frame = sorted(draw(st.sets(st.integers(0, 10**6), min_size=frames, max_size=frames)))
    return {
        "frame": np.array(frame),
        "time_s": np.array(frame) / draw(st.sampled_from([25, 100, 30000 / 1001])),
        "drones": tuple(draw(st.lists(names, unique=True, min_size=drones, max_size=drones))),
        "position_m": floats(3),
        "velocity_m_s": draw(st.none()) or floats(3),
        "fitness": floats(),
        "num_cameras": integers(8),
        "status": integers(2),
        "covariance_m2": draw(st.none()) or covariance(floats(3, 3)),
    }


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(data=st.data())
def test_reading_gives_what_was_written(suffix, dtype, data, tmp_path_factory):
    """To the last bit, in the precision of the written arrays."""
    path = tmp_path_factory.getbasetemp() / f"round_trip_{dtype.__name__}{suffix}"
    written = Trajectories(**data.draw(drawn_arguments(dtype)))
    write_trajectories(path, written, force=True)
    read = read_trajectories(path)
    assert read.drones == written.drones
    for name in ("frame", "time_s", "num_cameras", "status"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    for name in ("position_m", "velocity_m_s", "fitness", "covariance_m2"):
        expected = getattr(written, name)
        assert (getattr(read, name) is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(getattr(read, name).astype(dtype), expected)


# --- what is written


def test_exact_content_of_a_csv_file(tmp_path):
    write_trajectories(tmp_path / "tracks.csv", two_drones())
    assert (tmp_path / "tracks.csv").read_bytes().decode().split("\n") == [
        HEADER,
        "0,0.0,dron1,0.1,-2.0,1.5,0.25,0.25,0.25,0.7,8,tracked",
        "0,0.0,dron2,3.0,4.0,1.0,0.25,0.25,0.25,0.7,8,tracked",
        "1,0.04,dron1,0.1,-2.0,1.5,0.25,0.25,0.25,0.7,8,coasting",
        "1,0.04,dron2,3.0,4.0,1.0,0.25,0.25,0.25,0.7,8,coasting",
        "2,0.08,dron1,0.1,-2.0,1.5,0.25,0.25,0.25,0.7,8,tracked",
        "2,0.08,dron2,,,,0.25,0.25,0.25,0.7,8,lost",
        "",
    ]


def test_covariances_add_six_columns_and_parquet_has_the_same_rows_with_units(tmp_path):
    covariance_m2 = np.full((3, 2, 3, 3), np.nan)
    covariance_m2[0, 1] = [[1, 2, 3], [2, 5, 6], [3, 6, 9]]
    known = replace(two_drones(np.float64), covariance_m2=covariance_m2)
    for suffix in SUFFIXES:
        write_trajectories(tmp_path / f"tracks{suffix}", known)
    lines = (tmp_path / "tracks.csv").read_text().splitlines()
    assert lines[0] == f"{HEADER},cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    assert lines[1].endswith(",tracked,,,,,,")
    assert lines[2].endswith(",tracked,1.0,2.0,3.0,5.0,6.0,9.0")
    np.testing.assert_array_equal(read_trajectories(tmp_path / "tracks.csv").covariance_m2, covariance_m2)
    frame = pd.read_parquet(tmp_path / "tracks.parquet")
    pd.testing.assert_frame_equal(frame, pd.read_csv(tmp_path / "tracks.csv"), check_dtype=False)
    metadata = pq.read_schema(tmp_path / "tracks.parquet").metadata
    assert metadata[b"psotrack.schema_version"] == b"1"
    units = json.loads(metadata[b"psotrack.units"])
    assert units == {name: ALL_COLUMNS[name] for name in lines[0].split(",")}
    assert (units["x_m"], units["vx_m_s"], units["cov_xy"]) == ("m", "m/s", "m2")
    assert list(ALL_COLUMNS)[:12] == HEADER.split(",")


def test_exact_content_of_tum_files(tmp_path):
    orientation_wxyz = Rotation.random(6, rng=np.random.default_rng(0)).as_quat(scalar_first=True)
    turning = replace(two_drones(np.float64), orientation_wxyz=orientation_wxyz.reshape(3, 2, 4))
    table = np.loadtxt(write_tum(tmp_path / "turning", turning)[0])
    np.testing.assert_array_equal(table[:, 4:], turning.orientation_wxyz[:, 0][:, [1, 2, 3, 0]])
    first, second = write_tum(tmp_path / "tum", two_drones())
    assert (first.name, second.name) == ("dron1.tum", "dron2.tum")
    assert second.read_text().splitlines() == [
        "# timestamp tx ty tz qx qy qz qw",
        "# orientation unknown: 0 0 0 1 in every line",
        "0.0 3.0 4.0 1.0 0 0 0 1",
        "0.04 3.0 4.0 1.0 0 0 0 1",
    ]


# --- what is read leniently


def test_rows_and_columns_in_any_order_with_missing_and_extra_columns(tmp_path):
    """With a byte order mark and a blank line, and in Parquet with integers as names of drones."""
    path = tmp_path / "tracks.csv"
    rows = "\ufeffz_m,frame,x_m,y_m,note,drone\n1.5,2,0.5,3,nice,7\n1.5,1,0,3,,9\n\n1.5,2,-1,3,,9\n"
    path.write_text(rows, encoding="utf-8")
    pd.read_csv(path).to_parquet(path.with_suffix(".parquet"))
    for suffix in SUFFIXES:
        read = read_trajectories(path.with_suffix(suffix), fps=25.0)
        assert read.frame.tolist() == [1, 2]
        assert read.time_s.tolist() == [1 / 25, 2 / 25]
        assert read.drones == ("7", "9")
        np.testing.assert_array_equal(read.position_m[:, 0], [[np.nan] * 3, [0.5, 3, 1.5]])
        np.testing.assert_array_equal(read.position_m[:, 1], [[0, 3, 1.5], [-1, 3, 1.5]])
        assert set(read.quantities()) == {"position_m"}


def test_missing_rows_are_lost_and_a_time_stands_once_per_frame(tmp_path):
    rows = "0,,a,1,1,1,tracked,8\n1,0.04,b,1,1,1,coasting,7\n0,0,c,1,1,1,tracked,6\n"
    header = "frame,time_s,drone,x_m,y_m,z_m,status,num_cameras\n"
    (tmp_path / "tracks.csv").write_text(header + rows, encoding="utf-8")
    read = read_trajectories(tmp_path / "tracks.csv")
    assert read.time_s.tolist() == [0, 0.04]
    assert read.status.tolist() == [
        [Status.TRACKED, Status.LOST, Status.TRACKED],
        [Status.LOST, Status.COASTING, Status.LOST],
    ]
    assert read.num_cameras.tolist() == [[8, 0, 6], [0, 7, 0]]
