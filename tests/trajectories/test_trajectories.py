"""`Trajectories`: checks of the arrays, `seen`, and the choice of frames."""

from dataclasses import fields

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from psotrack.trajectories import Status, Trajectories, read_trajectories, resample, write_trajectories

FRAMES, DRONES = 5, 3


def make_trajectories(**changes) -> Trajectories:
    frame = np.arange(10, 10 + 2 * FRAMES, 2)
    position_m = np.arange(FRAMES * DRONES * 3, dtype=float).reshape(FRAMES, DRONES, 3)
    values = {"frame": frame, "time_s": frame / 25, "drones": ("a", "b", "c"), "position_m": position_m}
    return Trajectories(**(values | changes))


def make_full_trajectories() -> Trajectories:
    rng = np.random.default_rng(0)
    return make_trajectories(
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
    status[2, 1], status[3, 1] = Status.LOST, Status.COASTING
    unseen = np.argwhere(~make_trajectories(position_m=position_m, status=status).seen)
    assert unseen.tolist() == [[1, 0], [2, 1]]
    assert np.argwhere(~make_trajectories(position_m=position_m).seen).tolist() == [[1, 0]]


def test_at_frames_selects_the_same_rows_of_every_array():
    full = make_full_trajectories()
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
    kept = make_trajectories(covariance_m2=rounded).covariance_m2
    np.testing.assert_array_equal(kept, rounded)


def test_a_data_frame_has_the_columns_and_rows_of_a_file(tmp_path):
    tracks = make_trajectories(num_cameras=np.full((FRAMES, DRONES), 4))
    tracks.position_m[1, 1] = np.nan
    write_trajectories(tmp_path / "tracks.csv", tracks)
    frame = tracks.to_pandas()
    pd.testing.assert_frame_equal(frame, pd.read_csv(tmp_path / "tracks.csv"), check_dtype=False)
    assert make_trajectories().to_pandas()["num_cameras"].isna().all()
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
    found, expected = (
        Rotation.from_quat(each.orientation_wxyz[:, 0], scalar_first=True)
        for each in (
            resample(turning(sample_s, 60 * sample_s), np.arange(21), wanted_s),
            turning(wanted_s, 60 * wanted_s),
        )
    )
    # Splines of a steady turn are exact but for roundings.
    assert np.rad2deg((found.inv() * expected).magnitude()).max() < 1e-6


def test_orientations_are_unknown_in_gaps_and_in_half_turns():
    sample_s = np.array([0.0, 0.04, 0.08, 0.12, 0.16, 1.0])
    given = turning(sample_s, np.array([0.0, 5.0, 10.0, 175.0, 180.0, 185.0]))
    wanted_s = np.array([0.02, 0.08, 0.1, 0.12, 0.14, 0.5, 1.0])
    found = resample(given, np.arange(7), wanted_s).orientation_wxyz[:, 0]
    assert np.isfinite(found).all(axis=1).tolist() == [True, True, False, True, True, False, True]
