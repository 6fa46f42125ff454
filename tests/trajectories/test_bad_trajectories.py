"""Trajectories and their files that are refused: one line says what was expected, what was found, and in which line."""

import numpy as np
import pandas as pd
import pytest
from helpers import assert_refused

from psotrack.trajectories import Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.tum import read_tum, write_tum

HEADER = "frame,time_s,drone,x_m,y_m,z_m,status,num_cameras"
GOOD = "0,0,a,1,1,1,tracked,8"
#: Line 3 of a file of CSV whose line 2 is good, and a part of the message.
LINES = [
    ("1,0.04,a,1,1", "line 3: expected 8 fields as in the first line, found 5"),
    ("1,0.04,a,1,one,1,tracked,8", "line 3: expected a number in y_m, found 'one'"),
    (
        "1,0.04,a,1,inf,1,tracked,8",
        "expected a number of at most 1e+60 in size, or nothing in y_m, found inf",
    ),
    ("1,1e-320,a,1,1,1,tracked,8", "line 3: expected a time after 0 s, that of frame 0, found 9.99"),
    ("nan,0.04,a,1,1,1,tracked,8", "line 3: expected a whole number from 0 in frame, found nan"),
    ("inf,0.04,a,1,1,1,tracked,8", "line 3: expected a whole number from 0 in frame, found inf"),
    ("1.5,0.04,a,1,1,1,tracked,8", "line 3: expected a whole number from 0 in frame, found 1.5"),
    ("-1,0.04,a,1,1,1,tracked,8", "line 3: expected a whole number from 0 in frame, found -1.0"),
    ("\n\nnan,0,a,1,1,1,tracked,8", "line 5: expected a whole number"),
    ("1,0.04,,1,1,1,tracked,8", "line 3: expected a name in drone, found ''"),
    ("1,0.04,a,1,1,1,gone,8", "line 3: expected one of tracked, coasting, lost in status, found 'gone'"),
    ("1,0.04,a,1,1,1,tracked,x", "line 3: expected a number in num_cameras, found 'x'"),
    ("1,0.04,a,1,1,1,tracked,2.5", "expected a whole number from 0, or nothing in num_cameras, found 2.5"),
    ("0,0,a,2,2,2,tracked,8", "line 3: expected one row per frame and drone, found a second row for frame 0"),
    ("0,0.5,b,1,1,1,tracked,8", "line 3: expected 0 s as in another row of this frame, found 0.5 s"),
    ("1,,a,1,1,1,tracked,8", "line 3: expected a time_s, or a frame rate to compute it, found neither"),
    ('1,0.04,"a,1,1,1,tracked,8', "expected a CSV table in UTF-8"),
]
COVARIANCE = ",".join(f"cov_{axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
START = "frame,time_s,drone,x_m,y_m,z_m"
#: Name of a file, its text, and a part of the message.
BAD = [
    *(("tracks.csv", f"{HEADER}\n{GOOD}\n{line}\n", message) for line, message in LINES),
    *(
        (
            "tracks.csv",
            f"{START},{names}\n0,0.0,a,1,1,1,1,2,0,4,0,1\n1,0.04,a,1,1,1,,,,,,\n2,0.08,a,1,1,1,{cells}\n",
            f"line 4: expected a covariance in {names.replace(',', ', ')}",
        )
        for names in (COVARIANCE, COVARIANCE.replace("cov", "rel_cov"))
        for cells in ("1,2,0,1,0,1", "-1,0,0,1,0,1", "1,0,0,1,0,-1e50")
    ),
    ("tracks.csv", "frame,drone,x_m,y_m\n", "found z_m missing"),
    ("tracks.csv", "frame;drone;x_m;y_m;z_m\n", "found frame, drone, x_m, y_m, z_m missing"),
    ("tracks.csv", "frame,drone,x_m,y_m,z_m,x_m\n", "found x_m twice"),
    ("tracks.csv", "\n", "found frame, drone, x_m, y_m, z_m missing"),
    ("tracks.csv", f"{HEADER}\n", "expected at least one row, found none"),
    *(
        ("dron1.tum", f"# timestamp tx ty tz qx qy qz qw\n0 1 2 3 0 0 0 1\n{line}\n", message)
        for line, message in [
            ("0.04 1 2 3 0 0 0", "line 3: expected 8 finite numbers"),
            ("0.04 1 2 3 0 0 0 one", "line 3: expected 8 finite numbers"),
            ("0.04 1 2 nan 0 0 0 1", "line 3: expected 8 finite numbers"),
            ("0.04 1 2 3 0 0 0 0", "line 3: expected a quaternion"),
            ("0.0 1 2 3 0 0 0 1", "line 3: expected times that increase from line to line"),
        ]
    ),
    ("dron2.tum", "# timestamp tx ty tz qx qy qz qw\n", "at least one line with numbers"),
]


@pytest.mark.parametrize(("name", "text", "message"), BAD)
def test_a_bad_file_is_refused(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    read = read_tum if path.suffix == ".tum" else read_trajectories
    assert_refused(lambda: read(path), path, message, unchanged=tmp_path)


def table(**columns):
    one = {"drone": "a", "x_m": 1.0, "y_m": 1.0, "z_m": 1.0}
    return pd.DataFrame({"frame": [0, 1], "time_s": [0.0, 0.04]}).assign(**(one | columns))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"status": ["tracked", "sunk"]}, "row 2: expected one of tracked, coasting, lost in status, found"),
        ({"x_m": ["left", "right"]}, "expected numbers in x_m"),
    ],
)
def test_a_bad_parquet_file_is_refused(tmp_path, columns, message):
    path = tmp_path / "tracks.parquet"
    table(**columns).to_parquet(path)
    assert_refused(lambda: read_trajectories(path), path, message, unchanged=tmp_path)


def flight(**changes):
    frame = np.arange(10, 20, 2)
    position_m = np.zeros((5, 3, 3))
    values = {"frame": frame, "time_s": frame / 25, "drones": ("a", "b", "c"), "position_m": position_m}
    return Trajectories(**(values | changes))


#: What is done in a folder, and a part of the message.
BAD_CALLS = [
    (lambda _: flight(frame=np.array([0, 1, 1, 2, 3])), "increasing frame numbers"),
    (lambda _: flight(frame=np.array([0, 2, 1, 3, 4])), "increasing frame numbers"),
    (lambda _: flight(drones=("a", "b", "a")), "different names"),
    (
        lambda _: flight(covariance_m2=np.broadcast_to(np.eye(3) + np.eye(3, k=1), (5, 3, 3, 3))),
        "trajectories.covariance_m2: expected symmetric matrices",
    ),
    (lambda _: flight(covariance_m2=np.zeros((5, 4, 3, 3))), "covariance_m2"),
    *(
        (
            lambda _, wanted=wanted: flight().at_frames(np.array(wanted)),
            f"expected frames {wanted[0]} to {wanted[-1]}",
        )
        for wanted in ([11], [10, 20], [8])
    ),
    (lambda folder: read_trajectories(folder / "nowhere.csv"), "no such file"),
    (lambda folder: read_trajectories(folder / "nowhere.parquet"), "no such file"),
    (
        lambda folder: write_trajectories(folder / "tracks.txt", flight()),
        "tracks.txt: expected a name that ends in .csv or .parquet",
    ),
    *(
        (
            lambda folder, name=name: write_tum(folder, flight(drones=("fine", name, "c"))),
            "names that can be names of files",
        )
        for name in ("a/b", "")
    ),
]


@pytest.mark.parametrize(("call", "message"), BAD_CALLS)
def test_a_bad_call_is_refused(tmp_path, call, message):
    assert_refused(lambda: call(tmp_path), message, unchanged=tmp_path)
