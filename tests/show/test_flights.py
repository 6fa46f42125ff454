"""The room `flights`: where cameras show drones, ellipsoids, events, tables; and what the commands that show refuse."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_refused, cameras_of, opencv_pixels, ring_rig, sphere_points
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2
from worlds import CAMERAS, NUM_FRAMES, RATE_HZ, make_sequence, make_tracks, make_tracks_file

from psotrack.recordings import FrameTimes, Recording, view_in_images
from psotrack.recordings.exchange import export_tracks
from psotrack.show.flights import (
    EventKind,
    TrackedFlight,
    camera_quality,
    ellipsoids_90,
    find_events,
    find_recording,
    flight_of,
    read_flight,
    recording_beside,
)
from psotrack.show.flights.run_record import as_run_record
from psotrack.trajectories import Status, write_trajectories

SIZE_M = np.array([[0.4, 0.4, 0.2], [0.3, 0.3, 0.1]])


def tracks_with(*changes):
    """The drones of the small world, which are tracked but where (drone, frames, status) says otherwise."""
    status = np.full((NUM_FRAMES, 2), int(Status.TRACKED))
    for drone, frames, value in changes:
        status[frames, drone] = value
    return replace(make_tracks(), status=status)


def recording_of(rig, **fields):
    times = dict.fromkeys(rig.names, FrameTimes(NUM_FRAMES, RATE_HZ)) | fields.pop("times", {})
    return Recording("lab", Path("lab"), cameras_of(rig, times=times, **fields))


def flight_with(record, recording=None):
    """Tracks with a record."""
    (tracks,) = flight_of(tracks_with()).tracks
    return TrackedFlight("lab", (replace(tracks, record=as_run_record(record, "tracks")),), recording)


@pytest.mark.parametrize(
    ("camera", "offset_s", "line_time_s"), [(0, 0.0, 1e-4), (1, 0.015, 0.0), (2, 0.0, 0.0)]
)
def test_boxes_and_ellipses_are_about_the_drones_at_the_exposure(camera, offset_s, line_time_s):
    """The oracle projects points of surfaces by OpenCV, for a rolling shutter, a late camera, and a simple one."""
    rig = ring_rig(3, coefficients=5)
    name, number, seen_by = rig.names[camera], 6, rig.cameras[camera]
    late = FrameTimes(NUM_FRAMES, RATE_HZ, time_offset_s=offset_s)
    recording = recording_of(rig, times={name: late}, line_time_s={name: line_time_s})
    tracks = tracks_with()
    # Fast drones, one near the floor: the middle rows of the images show neither.
    velocity_m_s = np.broadcast_to([0.0, 5.0, 0.0], tracks.position_m.shape).copy()
    position_m = tracks.position_m * [1, 5, 1] - [[[0, 0, 0], [0, 0, 0.8]]]
    tracks = replace(tracks, position_m=position_m, velocity_m_s=velocity_m_s)
    views = view_in_images(recording, tracks, SIZE_M)
    assert (views.frame[:, camera] == np.arange(NUM_FRAMES)).all()
    assert views.boxes_px.shape == (NUM_FRAMES, 2, 3, 4)
    sphere = sphere_points(4000)
    for drone in range(2):
        # Rows are exposed one after the other from the frame's time on. During the exposure of the drone, the row
        # itself moves by less than two rows, 1 mm of flight, 0.1 pixels.
        place_m = position_m[number, drone]
        ((_, row_px),) = opencv_pixels(seen_by, place_m[None])
        exposed_s = offset_s + line_time_s * (row_px + 0.5)
        at_m = place_m + exposed_s * velocity_m_s[0, 0]
        pixels = opencv_pixels(seen_by, at_m + sphere * SIZE_M[drone] / 2) + 0.5
        expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
        # 4,000 points miss the outermost point of the surface by less than a fifth of a pixel.
        np.testing.assert_allclose(views.boxes_px[number, drone, camera], expected, atol=0.2)

        variance_m2 = np.diag(tracks.covariance_m2[number, drone])
        half_m = np.sqrt(variance_m2 * chi2.ppf(0.9, 3))
        off = opencv_pixels(seen_by, at_m + sphere * half_m)
        off -= views.middle_px[number, drone, camera]
        shape_px2 = views.shape_px2[number, drone, camera]
        radius2 = (off @ np.linalg.inv(shape_px2) * off).sum(axis=1)
        # None is outside, some are at the border. The linear approximation is exact to the ellipsoid's size over its
        # distance, 15 cm of 4 m.
        assert 0.97 < radius2.max() < 1.12


def test_no_box_where_a_drone_is_lost_or_outside_or_the_camera_has_no_frame():
    tracks = tracks_with((1, slice(3, 5), Status.LOST))
    tracks.position_m[8, 0] = 30.0, 0.0, 1.2
    short = recording_of(ring_rig(3), times={"c2": FrameTimes(6, RATE_HZ)})
    views = view_in_images(short, replace(tracks, covariance_m2=None), SIZE_M)
    shown = np.isfinite(views.boxes_px).all(axis=-1)
    assert shown[:3].all()
    assert not shown[3:5, 1].any()
    assert not shown[7:, :, 2].any()
    assert not shown[8, 0].all()
    assert np.isnan(views.shape_px2).all()


@given(seed=st.integers(0, 2**32 - 1))
def test_nine_of_ten_normal_points_are_inside_the_ellipsoid(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3, 3))
    covariance_m2 = np.stack([factor @ factor.T, np.full((3, 3), np.nan)])
    half_axes_m, rotation = ellipsoids_90(covariance_m2)
    points_m = rng.multivariate_normal(np.zeros(3), covariance_m2[0], 4000)
    own = points_m @ rotation[0] / half_axes_m[0]
    inside = np.mean(np.linalg.norm(own, axis=1) <= 1)
    # The standard deviation of the share is sqrt(0.9 * 0.1 / 4000) = 0.0047; six of it.
    assert abs(inside - 0.9) < 0.029
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, rtol=1e-9)
    assert np.isnan(half_axes_m[1]).all(), "unknown covariances have unknown ellipsoids"


def test_events_of_the_status():
    tracks = tracks_with(
        (0, slice(5, 9), Status.LOST),
        (1, slice(0, 2), Status.LOST),
        (1, slice(6, 12), Status.COASTING),
        (0, slice(10, 12), Status.COASTING),  # too short for an event
    )
    events = find_events(flight_of(tracks))
    assert [(event.frame, event.kind, event.drones) for event in events] == [
        (2, EventKind.BEGINS, ("1",)),
        (5, EventKind.LOST, ("0",)),
        (6, EventKind.COASTING, ("1",)),
        (9, EventKind.FOUND_AGAIN, ("0",)),
    ]
    assert events[2].text == "drone 1 is predicted for 0.24 s, without measurements"


def test_events_of_the_record_are_shown_at_their_times():
    """Frame 4 of a camera of 12.5 Hz that begins 0.08 s late is exposed at 0.4 s: instant 10 of 25 Hz."""
    met = {"drones": [0, 1], "first_frame": 3, "closest_frame": 6, "distance_m": 0.31, "last_frame": 9}
    met |= {"log_odds": 5.0, "outcome": "swapped"}
    slow = recording_of(ring_rig(2), times={"c1": FrameTimes(6, 12.5, time_offset_s=0.08)})
    # The second part begins behind the last frame.
    left_out = {"c1": [[4, 6], [6, 9]]}
    knock = {"camera": "c0", "frame": 7, "left_out": True, "shift_px": [3.0, 4.0]}
    record = {"encounters": [met], "left_out": left_out, "knocks": [knock]}
    first, knocked, second, third = find_events(flight_with(record, slow))
    assert (knocked.frame, knocked.text) == (7, "camera c0 was knocked")
    assert (first.frame, first.text) == (6, "drones 0 and 1 meet at 0.31 m; their labels: swapped")
    np.testing.assert_allclose(first.position_m, tracks_with().position_m[6].mean(axis=0))
    assert second.frame == 10
    assert second.text == "camera c1 is left out in 2 frames: foreground is everywhere"
    assert (third.frame, third.kind) == (12, EventKind.LEFT_OUT)


def test_the_quality_of_cameras():
    record = {
        "camera_errors": {"cameras": {"c1": {"noise_px": [3.0, 4.0], "lasting_px": [0.1, 0.1]}}},
        "explained": {"share": 0.9, "cameras": {"c1": 0.75}},
        "left_out": {"c2": [[0, 4], [6, 7]]},
    }
    short = recording_of(ring_rig(3), times={"c2": FrameTimes(NUM_FRAMES // 2, RATE_HZ)})
    rows = camera_quality(flight_with(record).tracks[0], short).set_index("camera")
    assert rows["frames"].tolist() == [1.0, 1.0, 0.5]
    assert rows.loc["c1", "noise_px"] == pytest.approx(np.sqrt(12.5))
    assert rows.loc["c1", "explained"] == 0.75
    assert rows["left_out"].tolist() == [0, 0, 5]
    assert (rows["in_view"] <= 1).all()


# --- reading


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    flight = read_flight([make_tracks_file(tmp_path / name / "tracks.csv") for name in ("a", "b")])
    assert [each.label for each in flight.tracks] == ["a/tracks", "b/tracks"]
    assert len({*flight.tracks[0].colours, *flight.tracks[1].colours}) == 2


@pytest.mark.parametrize(
    ("sequence", "folder"), [("home/flight", "home"), ("elsewhere/flight", "home"), ("home", "home/results")]
)
def test_tracks_know_their_recording(tmp_path, caplog, sequence, folder):
    """A recording is moved with tracks in its folder, and with those beside it; another one stays where it is."""
    recording = make_sequence(tmp_path / sequence)
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    tracks = make_tracks_file(tmp_path / folder / "tracks.csv")
    record = {"recording": recording_beside(recording / "recording.toml", tracks)}
    tracks.with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")
    (tmp_path / "home").rename(tmp_path / "moved")
    (tmp_path / "home").mkdir()
    tracks = tmp_path / folder.replace("home", "moved") / "tracks.csv"
    assert read_flight([tracks]).recording.rig.names == CAMERAS
    find_recording(tracks).rename(tmp_path / "gone")
    assert read_flight([tracks]).recording is None
    assert "recording.toml is not there; name the recording" in caplog.text


def test_exported_tracks_beside_a_file_are_no_record(tmp_path):
    path = make_tracks_file(tmp_path / "tracks.csv")
    export_tracks(make_tracks(), "json", path.with_suffix(".json"), force=True)
    (tracks,) = read_flight([path]).tracks
    assert tracks.record is None


# --- what is refused

#: Name of a file of tracks -> the record beside it.
RECORDS = {"other_types": '{"encounters": 3}', "of_a_barn": '{"sequence": "barn"}'}
#: Command -> words of the line.
BAD = {
    "view {tracks} {tracks} --save x.rrd": ["found one file twice"],
    "report {flight} {tracks}": [
        "flight: expected a file of tracks, found a recording; name the recording last"
    ],
    "report {tracks} --out x.pdf": ["ends in .html"],
    "report other_types.csv": ["other_types.json, encounters: expected a list"],
    "report of_a_barn.csv {flight}": ["expected tracks of flight, found tracks of barn"],
    "report longer.csv {flight}": ["from 0.00 to 0.52 s, as in flight, found 0.00 to 5.20 s"],
    "overlay late.csv {flight} --out x": ["0 to 0.52 s, found 100 to 100.52 s"],
    "overlay {tracks} {flight} --out x --cameras c9": ["c9"],
    "view --save x.rrd": ["Missing argument 'TRACKS... [SEQ]'"],
    "view {tracks} --save x.rrd --cameras c0": ["cameras: expected a recording"],
    "view {tracks} --save x.rrd --web": ["both"],
    "view {tracks} {flight} --save x.rrd --onboard": ["--onboard"],
    "view {tracks}": ["--save", "--web", "a screen"],
}


@pytest.mark.parametrize("command", BAD)
def test_wrong_input_is_one_line(run_psotrack, world, tmp_path, monkeypatch, command):
    """In a folder with files of tracks, without a screen."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    tracks = make_tracks()
    for name, text in RECORDS.items():
        write_trajectories(f"{name}.csv", tracks)
        Path(f"{name}.json").write_text(text, encoding="utf-8")
    write_trajectories("longer.csv", replace(tracks, time_s=10 * tracks.time_s))
    Path("longer.json").write_text("{}", encoding="utf-8")
    write_trajectories("late.csv", replace(tracks, time_s=tracks.time_s + 100))
    words = command.format(tracks=world / "tracks.csv", flight=world / "flight").split()
    assert_refused(lambda: run_psotrack(*words), *BAD[command], unchanged=tmp_path)
