"""Trajectories and their files that are refused: one line says what was expected, what was found, and in which line."""

import numpy as np
import pandas as pd
import pytest
from helpers import assert_refused

from psotrack.trajectories import Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.tum import read_tum, write_tum

START = "frame,time_s,drone,x_m,y_m,z_m"
HEADER = f"{START},status,num_cameras"
TUM = "# timestamp tx ty tz qx qy qz qw\n"
#: Line 3 of a file of CSV whose line 2 is good, and a part of the message.
LINES = {
    "1,0.04,a,1,1": "line 3: expected 8 fields as in the first line, found 5",
    "1,0.04,a,1,one,1,tracked,8": "line 3: expected a number in y_m, found 'one'",
    "1,0.04,a,1,inf,1,tracked,8": "expected a number of at most 1e+60 in size, or nothing in y_m, found inf",
    "1,1e-320,a,1,1,1,tracked,8": "line 3: expected a time after 0 s, that of frame 0, found 9.99",
    "inf,0.04,a,1,1,1,tracked,8": "line 3: expected a whole number from 0 in frame, found inf",
    "1.5,0.04,a,1,1,1,tracked,8": "line 3: expected a whole number from 0 in frame, found 1.5",
    "-1,0.04,a,1,1,1,tracked,8": "line 3: expected a whole number from 0 in frame, found -1.0",
    "\n\nnan,0,a,1,1,1,tracked,8": "line 5: expected a whole number",
    "1,0.04,,1,1,1,tracked,8": "line 3: expected a name in drone, found ''",
    "1,0.04,a,1,1,1,gone,8": "line 3: expected one of tracked, coasting, lost in status, found 'gone'",
    "1,0.04,a,1,1,1,tracked,2.5": "expected a whole number from 0, or nothing in num_cameras, found 2.5",
    "0,0,a,2,2,2,tracked,8": "line 3: expected one row per frame and drone, found a second row for frame 0",
    "0,0.5,b,1,1,1,tracked,8": "line 3: expected 0 s as in another row of this frame, found 0.5 s",
    "1,,a,1,1,1,tracked,8": "line 3: expected a time_s, or a frame rate to compute it, found neither",
    '1,0.04,"a,1,1,1,tracked,8': "expected a CSV table in UTF-8",
}
COVARIANCE = ",".join(f"cov_{axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
#: More columns -> their values in line 3, where line 2 has none, and a part of the message.
MATRICES = {
    COVARIANCE: ("1,2,0,1,0,1", f"line 3: expected a covariance in {COVARIANCE.replace(',', ', ')}"),
    COVARIANCE.replace("cov", "rel_cov"): (
        "1,0,0,1,0,-1e50",
        "line 3: expected a covariance in rel_cov_xx, ",
    ),
    "qw,qx,qy,qz": ("1,1,0,0", "line 3: expected a unit quaternion in qw, qx, qy, qz, found length 1.41421"),
}


def table(**columns):
    one = {"drone": "a", "x_m": 1.0, "y_m": 1.0, "z_m": 1.0}
    return pd.DataFrame({"frame": [0, 1], "time_s": [0.0, 0.04]}).assign(**(one | columns))


def flight(**changes):
    frame = np.arange(10, 20, 2)
    position_m = np.zeros((5, 3, 3))
    values = {"frame": frame, "time_s": frame / 25, "drones": ("a", "b", "c"), "position_m": position_m}
    return Trajectories(**(values | changes))


SKEW = np.broadcast_to(np.eye(3) + np.eye(3, k=1), (5, 3, 3, 3))
#: Name of a file, its content or None, what is done with its path, and a part of the message.
BAD = [
    *(
        ("tracks.csv", f"{HEADER}\n0,0,a,1,1,1,tracked,8\n{line}\n", read_trajectories, message)
        for line, message in LINES.items()
    ),
    *(
        (
            "tracks.csv",
            f"{START},{names}\n0,0.0,a,1,1,1{',' * cells.count(',')},\n1,0.04,a,1,1,1,{cells}\n",
            read_trajectories,
            message,
        )
        for names, (cells, message) in MATRICES.items()
    ),
    ("tracks.csv", "frame,drone,x_m,y_m\n", read_trajectories, "found z_m missing"),
    ("tracks.csv", "frame;drone;x_m;y_m;z_m\n", read_trajectories, "found frame, drone, x_m, y_m, z_m missing"),
    ("tracks.csv", "frame,drone,x_m,y_m,z_m,x_m\n", read_trajectories, "found x_m twice"),
    ("tracks.csv", f"{HEADER}\n", read_trajectories, "expected at least one row, found none"),
    ("nowhere.csv", None, read_trajectories, "no such file"),
    ("t.parquet", table(status=["tracked", "sunk"]), read_trajectories, "row 2: expected one of tracked, "),
    ("t.parquet", table(x_m=["left", "right"]), read_trajectories, "expected numbers in x_m"),
    *(
        ("dron1.tum", f"{TUM}0 1 2 3 0 0 0 1\n{line}\n", read_tum, f"line 3: expected {expected}")
        for line, expected in {
            "0.04 1 2 3 0 0 0": "8 finite numbers",
            "0.04 1 2 nan 0 0 0 1": "8 finite numbers",
            "0.04 1 2 3 0 0 0 0": "a quaternion",
            "0.0 1 2 3 0 0 0 1": "times that increase from line to line",
        }.items()
    ),
    ("dron2.tum", TUM, read_tum, "at least one line with numbers"),
    ("a.txt", None, lambda path: write_trajectories(path, flight()), "a name that ends in .csv or .parquet"),
    *(
        ("tum", None, lambda path, name=name: write_tum(path, flight(drones=("fine", name, "c"))), "names of files")
        for name in ("a/b", "")
    ),
    ("", None, lambda _: flight(frame=np.array([0, 1, 1, 2, 3])), "increasing frame numbers"),
    ("", None, lambda _: flight(frame=np.array([0, 2, 1, 3, 4])), "increasing frame numbers"),
    ("", None, lambda _: flight(drones=("a", "b", "a")), "different names"),
    ("", None, lambda _: flight(covariance_m2=SKEW), "trajectories.covariance_m2: expected symmetric matrices"),
    ("", None, lambda _: flight(covariance_m2=np.zeros((5, 4, 3, 3))), "covariance_m2"),
    *(
        ("", None, lambda _, frames=frames: flight().at_frames(np.array(frames)), f"frames {frames[0]} to")
        for frames in ([11], [10, 20], [8])
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "call", "message"), BAD)
def test_bad_trajectories_are_refused(tmp_path, name, content, call, message):
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif content is not None:
        content.to_parquet(path)
    assert_refused(lambda: call(path), message, unchanged=tmp_path)
