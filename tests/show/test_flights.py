"""The room `flights`: where cameras show drones, ellipsoids, events and tables, from files as users have them."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import assert_refused, cameras_of, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2
from worlds import make_sequence, make_tracks_file

from psotrack.recordings import FrameTimes, Recording, view_in_images
from psotrack.recordings.exchange import export_tracks
from psotrack.show.flights import (
    EventKind,
    camera_quality,
    ellipsoids_90,
    find_events,
    find_recording,
    read_flight,
    recording_beside,
    split_sequence,
)
from psotrack.trajectories import Status, Trajectories, write_trajectories

RATE_HZ = 10.0
SIZE_M = np.array([[0.4, 0.4, 0.2], [0.3, 0.3, 0.1]])


def recording_of(rig, num_frames=20, **fields) -> Recording:
    times = dict.fromkeys(rig.names, FrameTimes(num_frames, RATE_HZ)) | fields.pop("times", {})
    return Recording("lab", Path("lab"), cameras_of(rig, times=times, **fields))


def straight_tracks(num_frames=20, speed_m_s=2.0) -> Trajectories:
    """Two drones that fly along y, 1 m apart, with covariances of 1 to 3 cm."""
    time_s = np.arange(num_frames) / RATE_HZ
    position_m = np.zeros((num_frames, 2, 3))
    position_m[..., 0] = [-0.5, 0.5]
    position_m[..., 1] = (speed_m_s * (time_s - time_s.mean()))[:, None]
    position_m[..., 2] = 1.2
    velocity_m_s = np.zeros_like(position_m)
    velocity_m_s[..., 1] = speed_m_s
    return Trajectories(
        frame=np.arange(num_frames),
        time_s=time_s,
        drones=("0", "1"),
        position_m=position_m,
        velocity_m_s=velocity_m_s,
        status=np.full((num_frames, 2), Status.TRACKED),
        num_cameras=np.full((num_frames, 2), 3),
        fitness=np.full((num_frames, 2), 0.5),
        covariance_m2=np.broadcast_to(np.diag([1e-4, 4e-4, 9e-4]), (num_frames, 2, 3, 3)).copy(),
    )


def with_status(tracks: Trajectories, drone: int, frames: slice, status: Status) -> Trajectories:
    changed = tracks.status.copy()
    changed[frames, drone] = status
    return replace(tracks, status=changed)


def pixels_by_opencv(rig, camera: int, points_m):
    """(points, 2), pixels by OpenCV's own projection, as an oracle."""
    cam = rig.cameras[camera]
    rotation, _ = cv2.Rodrigues(cam.T_cam_world[:3, :3])
    pixels, _ = cv2.projectPoints(
        np.ascontiguousarray(points_m), rotation, cam.T_cam_world[:3, 3], cam.K, np.array(cam.dist)
    )
    return pixels[:, 0]


def write_flight(folder, tracks, record=None):
    """Files of tracks, with a record if one is given."""
    path = folder / "tracks.csv"
    write_trajectories(path, tracks)
    if record is not None:
        path.with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")
    return path


class TestImages:
    def test_boxes_hold_the_surface_of_each_drone(self):
        """The oracle projects points of the ellipsoids' surfaces by OpenCV."""
        rig, tracks = ring_rig(3, coefficients=5), straight_tracks()
        boxes_px = view_in_images(recording_of(rig), tracks, SIZE_M).boxes_px
        assert boxes_px.shape == (20, 2, 3, 4)
        direction = np.random.default_rng(0).normal(size=(4000, 3))
        sphere = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        for drone, camera in ((0, 1), (1, 2)):
            surface_m = tracks.position_m[7, drone] + sphere * SIZE_M[drone] / 2
            pixels = pixels_by_opencv(rig, camera, surface_m) + 0.5
            expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
            # 4,000 random points miss the outermost point of the surface by less than a fifth of a pixel.
            np.testing.assert_allclose(boxes_px[7, drone, camera], expected, atol=0.2)

    def test_a_late_camera_shows_drones_where_they_are_then(self):
        rig, tracks = ring_rig(3), straight_tracks()
        late = recording_of(rig, times={"c1": FrameTimes(20, RATE_HZ, time_offset_s=0.03)})
        boxes_px = view_in_images(late, tracks, SIZE_M).boxes_px
        moved = replace(tracks, position_m=tracks.position_m + 0.03 * tracks.velocity_m_s)
        expected = view_in_images(recording_of(rig), moved, SIZE_M).boxes_px
        # float32 keeps 320 pixels to 3e-5; each box has about ten operations.
        np.testing.assert_allclose(boxes_px[:, :, 1], expected[:, :, 1], atol=1e-2)
        assert (view_in_images(late, tracks, SIZE_M).frame[:, 1] == np.arange(20)).all()

    def test_rows_of_a_rolling_shutter_are_exposed_one_after_the_other(self):
        rig, tracks = ring_rig(3), straight_tracks(speed_m_s=3.0)
        rolling = recording_of(rig, line_time_s={"c0": 1e-4})
        boxes_px = view_in_images(rolling, tracks, SIZE_M).boxes_px[5, 0, 0]
        row_px = view_in_images(recording_of(rig), tracks, SIZE_M).boxes_px[5, 0, 0, [1, 3]].mean()
        # A rolling shutter's frame has the time of its middle row: frame 5 is exposed half a readout later.
        late_s = 1e-4 * 240 / 2 + 1e-4 * (row_px - 120)
        moved = replace(tracks, position_m=tracks.position_m + late_s * tracks.velocity_m_s)
        expected = view_in_images(recording_of(rig), moved, SIZE_M).boxes_px[5, 0, 0]
        # During the exposure of the drone the row itself moves by less than two rows, 0.6 mm of flight, 0.05 pixels.
        np.testing.assert_allclose(boxes_px, expected, atol=0.05)

    def test_no_box_where_a_drone_is_lost_behind_or_outside_or_the_camera_has_no_frame(self):
        rig, tracks = ring_rig(3), straight_tracks()
        tracks = with_status(tracks, 1, slice(3, 5), Status.LOST)
        tracks.position_m[8, 0] = 30.0, 0.0, 1.2
        short = recording_of(rig, times={"c2": FrameTimes(6, RATE_HZ)})
        boxes_px = view_in_images(short, tracks, SIZE_M).boxes_px
        shown = np.isfinite(boxes_px).all(axis=-1)
        assert not shown[3:5, 1].any()
        assert not shown[7:, :, 2].any()
        assert not shown[8, 0].all()
        assert shown[:3].all()

    def test_ellipses_are_the_outlines_of_the_90_percent_ellipsoids(self):
        """The oracle projects points of an ellipsoid's surface by OpenCV: none is outside, some are at the border."""
        rig, tracks = ring_rig(3, coefficients=5), straight_tracks()
        ellipses = view_in_images(recording_of(rig), tracks, SIZE_M)
        direction = np.random.default_rng(1).normal(size=(3000, 3))
        sphere = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        half_m = np.sqrt(np.diag(tracks.covariance_m2[4, 0]) * chi2.ppf(0.9, 3))
        pixels = pixels_by_opencv(rig, 1, tracks.position_m[4, 0] + sphere * half_m)
        off = pixels - ellipses.middle_px[4, 0, 1]
        radius2 = np.einsum("ni,ij,nj->n", off, np.linalg.inv(ellipses.shape_px2[4, 0, 1]), off)
        # The linear approximation is exact to the ellipsoid's size over its distance, 8 cm of 4 m.
        assert 0.97 < radius2.max() < 1.06

        bare = replace(tracks, covariance_m2=None)
        assert np.isnan(view_in_images(recording_of(rig), bare, SIZE_M).shape_px2).all()


class TestEllipsoids:
    @given(seed=st.integers(0, 2**32 - 1))
    def test_nine_of_ten_normal_points_are_inside(self, seed):
        rng = np.random.default_rng(seed)
        factor = rng.normal(size=(3, 3))
        covariance_m2 = factor @ factor.T
        found = ellipsoids_90(covariance_m2)
        own = rng.multivariate_normal(np.zeros(3), covariance_m2, 4000) @ found.rotation
        inside = (np.square(own / found.half_axes_m).sum(axis=1) <= 1).mean()
        # The standard deviation of the share is sqrt(0.9 * 0.1 / 4000) = 0.0047; six of it.
        assert abs(inside - 0.9) < 0.029
        np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0, rtol=1e-9)

    def test_unknown_covariances_have_unknown_ellipsoids(self):
        found = ellipsoids_90(np.full((2, 3, 3), np.nan))
        assert np.isnan(found.half_axes_m).all()
        assert np.isfinite(found.rotation).all()


class TestEvents:
    def test_lost_found_again_and_coasting(self, tmp_path):
        tracks = with_status(straight_tracks(), 0, slice(5, 9), Status.LOST)
        tracks = with_status(tracks, 1, slice(0, 2), Status.LOST)
        tracks = with_status(tracks, 1, slice(12, 15), Status.COASTING)
        tracks = with_status(tracks, 0, slice(14, 15), Status.COASTING)  # too short for an event
        events = find_events(read_flight([write_flight(tmp_path, tracks)]))
        assert [(event.frame, event.kind, event.drones) for event in events] == [
            (2, EventKind.BEGINS, ("1",)),
            (5, EventKind.LOST, ("0",)),
            (9, EventKind.FOUND_AGAIN, ("0",)),
            (12, EventKind.COASTING, ("1",)),
        ]
        assert events[3].text == "drone 1 is predicted for 0.30 s, without measurements"

    def test_encounters_and_left_out_frames_come_from_the_record(self, tmp_path):
        met = {
            "drones": [0, 1],
            "first_frame": 3,
            "closest_frame": 6,
            "distance_m": 0.31,
            "last_frame": 9,
            "log_odds": 5.0,
            "outcome": "swapped",
        }
        record = {"sequence": "lab", "encounters": [met], "left_out": {"c1": [[4, 6]]}}
        events = find_events(read_flight([write_flight(tmp_path, straight_tracks(), record)]))
        assert [(event.frame, event.text) for event in events] == [
            (4, "camera c1 is left out in 2 frames: foreground is everywhere"),
            (6, "drones 0 and 1 meet at 0.31 m; their labels: swapped"),
        ]

    def test_left_out_frames_of_a_late_slow_camera_are_shown_at_their_times(self, tmp_path, monkeypatch):
        """Frames 4 and 5 of a camera of 5 Hz that begins 0.2 s late are exposed from 1.0 s on: instant 10 of 10 Hz."""
        path = write_flight(tmp_path, straight_tracks(), {"sequence": "lab", "left_out": {"c1": [[4, 6]]}})
        slow = recording_of(ring_rig(2), times={"c1": FrameTimes(9, 5.0, time_offset_s=0.2)})
        monkeypatch.setattr("psotrack.show.flights.flight.open_recording", lambda _: slow)
        (event,) = find_events(read_flight([path], "lab"))
        assert (event.frame, event.kind) == (10, EventKind.LEFT_OUT)


class TestQuality:
    def test_cameras(self, tmp_path):
        record = {
            "camera_errors": {"cameras": {"c1": {"noise_px": [3.0, 4.0], "lasting_px": [0.1, 0.1]}}},
            "left_out": {"c2": [[0, 4], [6, 7]]},
        }
        (read,) = read_flight([write_flight(tmp_path, straight_tracks(), record)]).tracks
        short = recording_of(ring_rig(3), times={"c2": FrameTimes(10, RATE_HZ)})
        rows = camera_quality(read, short).set_index("camera")
        assert rows["frames"].tolist() == [1.0, 1.0, 0.5]
        assert rows.loc["c1", "noise_px"] == pytest.approx(np.sqrt(12.5))
        assert rows["left_out"].tolist() == [0, 0, 5]
        assert (rows["in_view"] <= 1).all()


def file_and_recording(folder):
    """A file of tracks beside the folder of a recording."""
    path = write_flight(folder, straight_tracks())
    (folder / "lab").mkdir()
    (folder / "lab" / "recording.toml").write_text("version = 1", encoding="utf-8")
    return [path, folder / "lab"]


def with_record(folder, text):
    path = write_flight(folder, straight_tracks())
    path.with_suffix(".json").write_text(text, encoding="utf-8")
    return [path]


def of_another_recording(folder, tracks, name):
    """Tracks with the name of their recording, and a recording of 14 frames at 25 Hz with the name `flight`."""
    return [write_flight(folder, tracks, {"sequence": name})], make_sequence(folder / "flight")


#: Name of the case -> what a folder is filled with, which gives the arguments of `read_flight`; words of the line.
BAD = {
    "nothing": (lambda folder: ((),), ("expected files of tracks, or a recording, found neither",)),
    "cameras without a recording": (
        lambda folder: ([write_flight(folder, straight_tracks())], None, ["c1"]),
        ("cameras: expected a recording",),
    ),
    "a file twice": (
        lambda folder: ([write_flight(folder, straight_tracks())] * 2,),
        ("found one file twice",),
    ),
    "a recording among the tracks": (
        lambda folder: (file_and_recording(folder),),
        ("lab: expected a file of tracks, found a recording; name the recording last",),
    ),
    "a record that is no JSON": (
        lambda folder: (with_record(folder, "{"),),
        ("tracks.json: expected the record of a run, ", "found an error"),
    ),
    "a record of a list": (
        lambda folder: (with_record(folder, "[1]"),),
        ("tracks.json: expected the record of a run, ", "found JSON with a list"),
    ),
    "a record of other types": (
        lambda folder: (with_record(folder, '{"encounters": 3}'),),
        ("tracks.json, encounters: expected a list",),
    ),
    "tracks of another recording": (
        lambda folder: of_another_recording(folder, straight_tracks(), "barn"),
        ("expected tracks of flight, found tracks of barn",),
    ),
    "tracks of a longer recording": (
        lambda folder: of_another_recording(folder, straight_tracks(num_frames=30), "flight"),
        ("expected times from 0.00 to 0.52 s, as in flight, found 0.00 to 2.90 s",),
    ),
}


class TestReading:
    @pytest.mark.parametrize("name", BAD)
    def test_what_cannot_be_read_is_one_line(self, tmp_path, name):
        fill, words = BAD[name]
        files, recording, cameras = (*fill(tmp_path), None, None)[:3]
        call = partial(read_flight, files, recording, cameras=cameras)
        assert_refused(call, *words, unchanged=tmp_path)

    def test_files_of_one_name_are_told_apart_by_their_folders(self, tmp_path):
        paths = [write_flight(folder, straight_tracks()) for folder in (tmp_path / "a", tmp_path / "b")]
        flight = read_flight(paths)
        assert [each.label for each in flight.tracks] == ["a/tracks", "b/tracks"]
        assert len({*flight.tracks[0].colours, *flight.tracks[1].colours}) == 2

    def test_the_recording_is_named_last(self, tmp_path):
        path, lab = file_and_recording(tmp_path)
        assert split_sequence([path, lab]) == ((path,), lab)
        assert split_sequence([path]) == ((path,), None)

    def test_tracks_in_the_folder_of_their_recording_know_it_where_it_moves(self, tmp_path):
        sequence = make_sequence(tmp_path / "lab")
        (sequence / "results").mkdir()
        tracks = make_tracks_file(sequence / "results" / "tracks.csv")
        assert (
            recording_beside(sequence, tracks)
            == recording_beside(sequence / "recording.toml", tracks)[:2]
            == ".."
        )

    @pytest.mark.parametrize("folder", ["flight", "../elsewhere/flight"])
    def test_tracks_know_their_recording(self, tmp_path, caplog, folder):
        """A recording in the folder of the tracks is moved with it; another one stays where it is."""
        sequence = make_sequence(tmp_path / "home" / folder)
        tracks = make_tracks_file(tmp_path / "home" / "tracks.csv")
        record = json.loads(tracks.with_suffix(".json").read_text(encoding="utf-8"))
        record["recording"] = recording_beside(sequence, tracks)
        tracks.with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")
        tracks = (tmp_path / "home").rename(tmp_path / "moved") / "tracks.csv"
        if folder == "../elsewhere/flight":
            (tmp_path / "home").mkdir()
        assert read_flight([tracks]).recording.name == "flight"
        find_recording(tracks).rename(tmp_path / "gone")
        assert read_flight([tracks]).recording is None
        assert "flight is not there; name the recording" in caplog.text

    def test_exported_tracks_beside_a_file_are_no_record(self, tmp_path):
        path = write_flight(tmp_path, straight_tracks())
        export_tracks(straight_tracks(), "json", path.with_suffix(".json"))
        (tracks,) = read_flight([path]).tracks
        assert tracks.record is None
