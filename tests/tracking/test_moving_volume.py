"""Bounds and speed limit from what moves, two views that begin a track, and the warning of a track that is cut off."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import make_unnamed_rig

from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, project
from psotrack.geometry.rig_files import write_rig
from psotrack.pipeline import track_recording
from psotrack.recordings import Detections, write_detections
from psotrack.recordings.datasets import open_recording
from psotrack.settings import MotionSettings, StatusSettings, TrackSettings
from psotrack.tracking.births import find_cut_off, find_outside, flight_volume, moving_points, room_bounds
from psotrack.tracking.lines import track_detections
from psotrack.tracking.matching import Sightings, from_detections, match
from psotrack.trajectories import Status

FORMULA = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "accuracy" / "formula_flights.py"))
SCENES, make_flight = FORMULA["SCENES"], FORMULA["make_flight"]

FPS = 25.0
K = np.array([[1000.0, 0, 960], [0, 1000.0, 540], [0, 0, 1]])
SKY_M = (0.0, 0.0, 15.0)


def ground_rig(num_cameras, target_m=SKY_M, height_m=1.5):
    """Cameras on the ground on a circle of 25 m, which all look at one place."""
    cameras = []
    for angle in 2 * np.pi * np.arange(num_cameras) / num_cameras + 0.3:
        R, t_m = look_at([25 * np.cos(angle), 25 * np.sin(angle), height_m], target_m)
        cameras.append(make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080)))
    return make_unnamed_rig(*cameras)


def flights(num_frames, speeds_m_s, centre_m=SKY_M):
    """Positions (frames, drones, 3) of drones on horizontal circles of 8 m, one above the other."""
    time_s = np.arange(num_frames)[:, None] / FPS
    angle = np.array(speeds_m_s) / 8.0 * time_s + 2.0 * np.arange(len(speeds_m_s))
    height_m = np.broadcast_to(centre_m[2] + 1.5 * np.arange(len(speeds_m_s)), angle.shape)
    return np.stack([8 * np.cos(angle), 8 * np.sin(angle), height_m], axis=-1) + np.array(
        [*centre_m[:2], 0.0]
    )


def sightings_of(rig, truth_m, seed=0, clutter=1, hidden=()):
    """Boxes with errors of 1 px and false alarms; the cameras in `hidden` see nothing but false alarms."""
    rng = np.random.default_rng(seed)
    centre = np.swapaxes(np.asarray(project(rig.cameras, truth_m[:, :, None])[0]), 1, 2)
    centre = centre + rng.normal(0, 1.0, centre.shape)
    outside = (centre < 0).any(axis=-1) | (centre > (1919, 1079)).any(axis=-1)
    centre[outside] = np.nan
    centre[:, list(hidden)] = np.nan
    false = rng.uniform(0, (1919, 1079), (*centre.shape[:2], clutter, 2))
    centre = np.concatenate([centre, false], axis=2)
    noise = np.where(np.isfinite(centre[..., 0]), 1.5, np.nan)
    return Sightings(centre, np.where(np.isfinite(centre), 12.0, np.nan), noise)


def joined(one, other, axis):
    """The sightings of both, one after the other along frames (0) or boxes (2)."""
    return Sightings(
        *(
            np.concatenate([getattr(each, name) for each in (one, other)], axis=axis)
            for name in ("centre_px", "size_px", "noise_px")
        )
    )


def tracked(rig, sightings, volume, size_m=None, **status):
    motion = MotionSettings(max_speed_m_s=volume.max_speed_m_s)
    settings = TrackSettings(motion=motion, status=StatusSettings(**status))
    settings = settings.changed({"drones.size_m": size_m})
    return track_detections(rig.cameras, sightings, settings, fps=FPS, bounds_m=volume.bounds_m)[0]


def test_the_volume_holds_drones_far_above_the_cameras_and_their_speed():
    rig, truth_m = ground_rig(4), flights(60, (4.0, 11.0))
    points = moving_points(rig, sightings_of(rig, truth_m), FPS)
    volume = flight_volume(rig, points)
    assert volume.bounds_from == "cameras and moving points"
    assert volume.speed_from == "moving points"
    assert ((truth_m >= volume.bounds_m[0]) & (truth_m <= volume.bounds_m[1])).all()
    # The margin beyond the highest drone is a metre; false alarms do not widen the volume.
    assert 16.5 < volume.bounds_m[1, 2] < 20
    assert 11.0 < volume.max_speed_m_s < 2 * 11.0
    # A recording may be shorter than the time that is searched at once.
    assert len(moving_points(rig, sightings_of(rig, truth_m)[:16], FPS))


@pytest.mark.slow
def test_things_smaller_than_usual_drones_are_found_where_their_size_is_given():
    """Balls of 5 cm: 2 px wide in the cameras, 28 m away."""
    rig, truth_m, size_m = ground_rig(4), flights(60, (4.0, 11.0)), (0.05, 0.05, 0.05)
    drones = sightings_of(rig, truth_m)
    balls = replace(drones, size_px=drones.size_px / 6.5)
    assert not len(moving_points(rig, balls, FPS))
    volume = flight_volume(rig, moving_points(rig, balls, FPS, size_m))
    assert volume.bounds_from == "cameras and moving points"
    assert tracked(rig, balls, volume).num_drones == 0
    assert tracked(rig, balls, volume, size_m).num_drones == 2
    # A given size that is wrong hides no usual drone.
    assert tracked(rig, drones, volume, list(size_m)).num_drones == 2


def test_given_values_win():
    rig, truth_m = ground_rig(4), flights(30, (11.0,))
    points = moving_points(rig, sightings_of(rig, truth_m), FPS)
    volume = flight_volume(rig, points, bounds_m=(-1.0, 1.0, -2.0, 2.0, 0.0, 3.0), max_speed_m_s=5.0)
    np.testing.assert_array_equal(volume.bounds_m, [[-1, -2, 0], [1, 2, 3]])
    assert (volume.bounds_from, volume.max_speed_m_s, volume.speed_from) == ("given", 5.0, "given")
    assert volume.record["bounds_m"] == [[-1.0, -2.0, 0.0], [1.0, 2.0, 3.0]]
    assert "outside of the given bounds" in find_outside(volume)
    assert "--max-speed" in find_outside(flight_volume(rig, points, max_speed_m_s=5.0))
    assert find_outside(flight_volume(rig, points)) is None


def test_false_alarms_and_what_moves_below_a_floor_leave_the_room_of_the_cameras():
    rig = ground_rig(4)
    points = moving_points(rig, sightings_of(rig, flights(60, ()), clutter=3), FPS)
    volume = flight_volume(rig, points)
    np.testing.assert_array_equal(volume.bounds_m, room_bounds(rig))
    assert (volume.bounds_from, volume.max_speed_m_s) == ("cameras", 6.0)
    # Reflections in the floor of a room agree in all cameras, and move with the drones.
    rig = ground_rig(4, target_m=(0.0, 0.0, 1.0), height_m=9.0)
    real_m = flights(30, (2.0,), centre_m=(0.0, 0.0, 2.0))
    both_m = np.concatenate([real_m, real_m * (1, 1, -1)], axis=1)
    volume = flight_volume(rig, moving_points(rig, sightings_of(rig, both_m), FPS))
    np.testing.assert_array_equal(volume.bounds_m, room_bounds(rig))


def test_two_cameras_begin_a_track_where_there_is_no_third():
    rig = ground_rig(5)
    pair = make_unnamed_rig(rig.cameras[0], rig.cameras[1])
    truth_m = flights(40, (4.0, 3.0))
    volume = flight_volume(pair, None, bounds_m=(-20.0, 20.0, -20.0, 20.0, 0.0, 30.0))
    sightings = sightings_of(pair, truth_m)
    tracks = tracked(pair, sightings, volume)
    assert tracks.num_drones == 2
    assert (tracks.status == Status.TRACKED).mean() > 0.95
    # The covariance says that two lines of sight determine the place worse than five.
    five = tracked(rig, sightings_of(rig, truth_m), volume)
    spread = [np.trace(each.covariance_m2[20, 0]) for each in (tracks, five)]
    assert spread[0] > 1.5 * spread[1]
    assert tracked(pair, sightings, volume, min_cameras_to_begin=3).num_drones == 0


def test_two_cameras_keep_a_track_that_three_began_and_begin_one_late_that_a_third_should_see():
    rig, truth_m = ground_rig(3), flights(50, (4.0,))
    volume = flight_volume(rig, None, bounds_m=(-20.0, 20.0, -20.0, 20.0, 0.0, 30.0))
    three, two = (sightings_of(rig, truth_m, hidden=hidden) for hidden in ((), (2,)))
    kept = tracked(rig, joined(three[:12], two[12:], axis=0), volume)
    assert kept.num_drones == 1
    assert (kept.status[:, 0] == Status.TRACKED).all()
    assert tracked(rig, sightings_of(rig, truth_m[:25], hidden=(2,)), volume).num_drones == 0
    assert tracked(rig, two, volume, min_cameras_to_begin=2).num_drones == 1
    # A post before the third camera hides the drone: after 30 frames the track counts, from its begin on.
    hidden = tracked(rig, two, volume)
    assert hidden.num_drones == 1
    assert (hidden.status[:, 0] == Status.TRACKED).mean() > 0.9
    assert tracked(rig, two, volume, min_cameras_to_begin=3).num_drones == 0


def test_the_volume_holds_a_drone_that_something_hides_from_the_third_camera():
    rig = ground_rig(3)
    truth_m = np.concatenate([flights(60, (4.0,)), flights(60, (1.0,), centre_m=(0.0, 0.0, 22.0))], axis=1)
    low, high = sightings_of(rig, truth_m[:, :1]), sightings_of(rig, truth_m[:, 1:], hidden=(1,), clutter=0)
    both = joined(low, high, axis=2)
    volume = flight_volume(rig, moving_points(rig, both, FPS))
    assert 22.0 < volume.bounds_m[1, 2] < 27.0
    assert tracked(rig, both, volume).num_drones == 2


@pytest.mark.slow
def test_a_fast_drone_far_away_is_not_two():
    """A sharp turn brings a drone out of its gate; three cameras that agree beside the place keep its track."""
    flight = make_flight(SCENES["outdoors, 4 cameras, 3 drones on 100 m"], 250, 54)
    sightings = from_detections(flight.detections, flight.rig, flight.num_frames)
    volume = flight_volume(flight.rig, moving_points(flight.rig, sightings, FPS))
    tracks = tracked(flight.rig, sightings, volume)
    assert tracks.num_drones == 3


@pytest.mark.parametrize(
    ("largest_y_m", "max_speed_m_s", "expected"),
    [
        (20.0, 12.0, None),
        (5.0, 12.0, "was lost at the bound y = 5.0 m; if it flies on, pass wider --bounds"),
        (20.0, 4.0, "flies at the speed limit of 4 m/s; if it is faster, pass a higher --max-sp"),
    ],
)
def test_a_track_that_is_cut_off_is_named_with_the_option(largest_y_m, max_speed_m_s, expected):
    rig, truth_m = ground_rig(4), flights(60, (5.0,))
    bounds_m = (-20.0, 20.0, -20.0, largest_y_m, 0.0, 30.0)
    volume = flight_volume(rig, None, bounds_m=bounds_m, max_speed_m_s=max_speed_m_s)
    line = find_cut_off(tracked(rig, sightings_of(rig, truth_m, clutter=0), volume), volume, FPS)
    if expected is None:
        assert line is None
    else:
        assert expected in line
        assert line.startswith("frame ")


def test_two_views_match_wherever_the_middle_of_the_searched_room_is():
    """The room's middle is between the cameras, where a ray has no depth yet; the drone is 100 m away."""
    cameras = []
    for x_m in (-7.0, 7.0):
        R, t_m = look_at([x_m, 0.0, 1.5], [0.0, 80.0, 60.0])
        cameras.append(make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080)))
    pair = make_unnamed_rig(*cameras).cameras
    place_m = np.array([[3.0, 80.0, 60.0]])
    pixels = np.asarray(project(pair, place_m[:, None])[0])[0]
    room_m = np.array([[-300.0, -300.0, -300.0], [300.0, 300.0, 303.0]])
    found = match(pair, pixels[:, None], np.ones((2, 1)), bounds_m=room_m, min_views=None)
    np.testing.assert_allclose(found.position_m, place_m, atol=0.1)


def test_a_recording_of_detections_is_tracked_within_the_volume_that_is_found(tmp_path, caplog):
    rig, truth_m = ground_rig(3), flights(30, (9.0,))
    sightings = sightings_of(rig, truth_m)
    write_rig(tmp_path / "rig.toml", rig)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for camera, name in enumerate(rig.names):
        frame, box = np.nonzero(np.isfinite(sightings.noise_px[:, camera]))
        centre = sightings.centre_px[frame, camera, box] + 0.5
        boxes = np.concatenate([centre - 6, centre + 6], axis=1)
        write_detections(tmp_path / f"{name}.csv", Detections(frame, boxes, np.ones(len(frame))))
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', "size = [1920, 1080]", f"fps = {FPS}"]
    (tmp_path / "recording.toml").write_text("\n".join(lines) + "\n")
    settings = TrackSettings(method="projection-lines")
    tracked = track_recording(open_recording(tmp_path), settings, cache=tmp_path / "cache")
    assert tracked.trajectories.num_drones == 1
    assert tracked.record["volume"]["bounds_from"] == "cameras and moving points"
    assert tracked.record["volume"]["speed_from"] == "moving points"
    assert caplog.text == ""
    told = settings.changed({"bounds_m": (-9.0, 9.0, -9.0, 9.0, 0.0, 9.0)})
    with pytest.raises(InputError, match="found none in any frame"):
        track_recording(open_recording(tmp_path), told, cache=tmp_path / "cache")
    assert "100% of what moves is outside of the given bounds; pass wider --bounds" in caplog.text
