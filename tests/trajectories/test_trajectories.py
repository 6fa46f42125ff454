"""`Trajectories`: `seen`, the choice of frames, times between samples, and what is refused, in files as well.

A refusal is one line that says what was expected, what was found, and in which line.
"""

from dataclasses import fields

import jaxtyping
import numpy as np
import pandas as pd
import pytest
from helpers import assert_refused
from scipy.spatial.transform import Rotation

from psotrack.errors import PsotrackError
from psotrack.trajectories import Status, Trajectories, read_trajectories, resample, write_trajectories
from psotrack.trajectories.tum import read_tum, write_tum

FRAMES, DRONES = 5, 3


def flight(**changes):
    frame = np.arange(10, 10 + 2 * FRAMES, 2)
    position_m = np.arange(FRAMES * DRONES * 3, dtype=float).reshape(FRAMES, DRONES, 3)
    values = {"frame": frame, "time_s": frame / 25, "drones": ("a", "b", "c"), "position_m": position_m}
    return Trajectories(**(values | changes))


def full_flight():
    rng = np.random.default_rng(0)
    return flight(
        velocity_m_s=rng.normal(size=(FRAMES, DRONES, 3)),
        orientation_wxyz=rng.normal(size=(FRAMES, DRONES, 4)),
        fitness=rng.random((FRAMES, DRONES)),
        num_cameras=rng.integers(0, 9, (FRAMES, DRONES)),
        status=rng.integers(0, 3, (FRAMES, DRONES)),
        covariance_m2=random_covariances(rng),
        relative_covariance_m2=random_covariances(rng),
    )


def random_covariances(rng):
    root = rng.normal(size=(FRAMES, DRONES, 3, 3))
    return root @ np.swapaxes(root, -1, -2)


def test_seen_needs_a_complete_position_that_is_not_lost():
    position_m = np.zeros((FRAMES, DRONES, 3))
    position_m[1, 0, 2] = np.nan
    status = np.full((FRAMES, DRONES), Status.TRACKED)
    status[2, 1] = Status.LOST
    status[3, 1] = Status.COASTING
    tracks = flight(position_m=position_m, status=status)
    assert np.argwhere(~tracks.seen).tolist() == [[1, 0], [2, 1]]


def test_at_frames_selects_the_same_rows_of_every_array():
    full = full_flight()
    picked = full.at_frames(np.array([12, 18]))
    assert picked.frame.tolist() == [12, 18]
    assert picked.drones == full.drones
    rest = {field.name for field in fields(full)} - {"frame", "drones"}
    assert len(rest) == 9
    for name in rest:
        np.testing.assert_array_equal(getattr(picked, name), getattr(full, name)[[1, 4]])


def test_a_known_covariance_must_be_symmetric_within_rounding():
    """Matrices with NaN are not checked."""
    rng = np.random.default_rng(1)
    # The upper and the lower half differ by the last bit of float32.
    rounded = random_covariances(rng).astype(np.float32)
    rounded[..., 0, 2] = np.nextafter(rounded[..., 2, 0], np.float32(np.inf))
    rounded[1, 2] = np.nan
    rounded[2, 0, 0, 1] = np.nan
    kept = flight(covariance_m2=rounded).covariance_m2
    np.testing.assert_array_equal(kept, rounded)


def test_a_data_frame_has_the_columns_and_rows_of_a_file(tmp_path):
    tracks = flight(num_cameras=np.full((FRAMES, DRONES), 4))
    tracks.position_m[1, 1] = np.nan
    write_trajectories(tmp_path / "tracks.csv", tracks)
    frame = tracks.to_pandas()
    pd.testing.assert_frame_equal(frame, pd.read_csv(tmp_path / "tracks.csv"), check_dtype=False)
    assert flight().to_pandas()["num_cameras"].isna().all()
    # Where no status is known, a drone without a position is lost; other unknown quantities stay unknown.
    read = read_trajectories(tmp_path / "tracks.csv")
    assert np.argwhere(read.status == Status.LOST).tolist() == [[1, 1]]
    assert set(read.quantities()) == {"position_m", "status", "num_cameras"}


def turning(sample_s, turn_deg):
    """A drone that turns about the vertical."""
    turns = Rotation.from_rotvec(turn_deg[:, None] * [0.0, 0.0, 1.0], degrees=True)
    orientation_wxyz = turns.as_quat(scalar_first=True)[:, None]
    count = len(sample_s)
    return Trajectories(
        np.arange(count), sample_s, ("a",), np.zeros((count, 1, 3)), orientation_wxyz=orientation_wxyz
    )


def test_orientations_between_samples_are_those_of_a_steady_turn():
    """Found: splines went through the entries of rotation matrices, which are no steady turn between samples."""
    sample_s, wanted_s = np.arange(6.0), np.linspace(0, 5, 21)
    expected = turning(wanted_s, 60 * wanted_s).orientation_wxyz[:, 0]
    tracks = resample(turning(sample_s, 60 * sample_s), np.arange(21), wanted_s)
    found = Rotation.from_quat(tracks.orientation_wxyz[:, 0], scalar_first=True)
    off = found.inv() * Rotation.from_quat(expected, scalar_first=True)
    # Splines of a steady turn are exact but for roundings.
    assert np.rad2deg(off.magnitude()).max() < 1e-6


def test_orientations_are_unknown_in_gaps_and_in_half_turns():
    sample_s = np.array([0.0, 0.04, 0.08, 0.12, 0.16, 1.0])
    given = turning(sample_s, np.array([0.0, 5.0, 10.0, 175.0, 180.0, 185.0]))
    wanted_s = np.array([0.02, 0.08, 0.1, 0.12, 0.14, 0.5, 1.0])
    found = resample(given, np.arange(7), wanted_s).orientation_wxyz[:, 0]
    assert np.isfinite(found).all(axis=1).tolist() == [True, True, False, True, True, False, True]


# --- what is refused

START = "frame,time_s,drone,x_m,y_m,z_m"
HEADER = f"{START},status,num_cameras"
TUM = "# timestamp tx ty tz qx qy qz qw\n"
#: Line 3 of a file of CSV whose line 2 is good, and a part of the message.
LINES = {
    "1,0.04,a,1,1": "line 3: expected 8 fields as in the first line, found 5",
    "1,0.04,a,1,one,1,tracked,8": "line 3: expected a number in y_m, found 'one'",
    "1,0.04,a,1,inf,1,tracked,8": "expected a number of at most 1e+60 in size, or nothing in y_m, found inf",
    "1,1e-320,a,1,1,1,tracked,8": "line 3: expected a time after 0 s, that of frame 0, found 9.99",
    "1,0.04,,1,1,1,tracked,8": "line 3: expected a name in drone, found ''",
    "1,0.04,a,1,1,1,gone,8": "line 3: expected one of tracked, coasting, lost in status, found 'gone'",
    "1,0.04,a,1,1,1,tracked,2.5": "expected a whole number from 0, or nothing in num_cameras, found 2.5",
    "0,0,a,2,2,2,tracked,8": "line 3: expected one row per frame and drone, found a second row for frame 0",
    "0,0.5,b,1,1,1,tracked,8": "line 3: expected 0 s as in another row of this frame, found 0.5 s",
    "1,,a,1,1,1,tracked,8": "line 3: expected a time_s, or a frame rate to compute it, found neither",
}
#: The same for a file of TUM.
TUM_LINES = {
    "0.04 1 2 3 0 0 0": "8 finite numbers",
    "0,04 1,5 2 3 0 0 0 1": "8 finite numbers: timestamp tx ty tz qx qy qz qw, with decimal points",
    "0.04 1 2 3 0 0 0 0": "a quaternion",
    "0.0 1 2 3 0 0 0 1": "times that increase from line to line",
}
COVARIANCE = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
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


SKEW = np.broadcast_to(np.eye(3) + np.eye(3, k=1), (5, 3, 3, 3))
SUNK = table(status=["tracked", "sunk"])
#: Name of a file, its content or None, what is done with its path, and a part of the message.
BAD = [
    ("tracks.csv", "frame,drone,x_m,y_m\n", read_trajectories, "found z_m missing"),
    ("tracks.csv", "frame,drone,x_m,y_m,z_m,x_m\n", read_trajectories, "found x_m twice"),
    ("tracks.csv", f"{HEADER}\n", read_trajectories, "expected at least one row, found none"),
    ("t.parquet", SUNK, read_trajectories, "row 2: expected one of tracked, "),
    ("t.parquet", table(x_m=["left", "right"]), read_trajectories, "expected numbers in x_m"),
    ("dron2.tum", TUM, read_tum, "at least one line with numbers"),
    ("a.txt", None, lambda path: write_trajectories(path, flight()), "a name that ends in .csv or .parquet"),
    ("tum", None, lambda path: write_tum(path, flight(drones=("a", "a/b", "c"))), "names of files"),
    ("", None, lambda _: flight(frame=np.array([0, 1, 1, 2, 3])), "increasing frame numbers"),
    ("", None, lambda _: flight(drones=("a", "b", "a")), "different names"),
    ("", None, lambda _: flight(covariance_m2=SKEW), "trajectories.covariance_m2: expected symmetric matrices"),
    ("", None, lambda _: flight().at_frames(np.array([11])), "frames 11 to"),
    ("", None, lambda _: flight().at_frames(np.array([10, 20])), "frames 10 to"),
]  # fmt: skip
for line, message in LINES.items():
    text = f"{HEADER}\n0,0,a,1,1,1,tracked,8\n{line}\n"
    BAD.append(("tracks.csv", text, read_trajectories, message))
for names, (cells, message) in MATRICES.items():
    unknown = "," * cells.count(",")
    text = f"{START},{names}\n0,0.0,a,1,1,1{unknown},\n1,0.04,a,1,1,1,{cells}\n"
    BAD.append(("tracks.csv", text, read_trajectories, message))
for line, message in TUM_LINES.items():
    BAD.append(("dron1.tum", f"{TUM}0 1 2 3 0 0 0 1\n{line}\n", read_tum, f"line 3: expected {message}"))


@pytest.mark.parametrize(("name", "content", "call", "message"), BAD)
def test_bad_trajectories_are_refused(tmp_path, name, content, call, message):
    path = tmp_path / name
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif content is not None:
        content.to_parquet(path)
    assert_refused(lambda: call(path), message, unchanged=tmp_path)


def test_covariances_of_other_drones_are_refused():
    # Where types are checked at run time, the annotation refuses them first.
    with pytest.raises((PsotrackError, jaxtyping.TypeCheckError), match="covariance_m2"):
        flight(covariance_m2=np.zeros((5, 4, 3, 3)))
