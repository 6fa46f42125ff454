"""Cameras with clocks of their own: detections and clocks, on flights that are formulas, so that the truth is exact."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from drawn_flights import REDUCTION, SIZE_M, draw, run_inputs
from drawn_flights import RIG as DRAWN_RIG
from helpers import ROOM_M, cameras_of, ring_rig, silhouettes_in_memory, with_cameras
from hypothesis import given
from hypothesis import strategies as st
from seen_boxes import FPS, track, true_boxes

from psotrack.calibration.clocks import (
    ReferenceOffset,
    camera_offsets,
    clocks_of_tracks,
    fit_clocks,
    places_of_tracks,
)
from psotrack.calibration.doctor import examine
from psotrack.evaluation import find_offset
from psotrack.foreground.silhouettes import Exposures, Silhouettes
from psotrack.geometry import make_extents, project, project_boxes
from psotrack.recordings import FrameTimes, Recording, VideoInfo, make_timeline
from psotrack.tracking.births import Births, FlightLimits, InitialState, KnownDrones
from psotrack.tracking.matching import NOISE_PX, Sightings
from psotrack.tracking.swarm import track_silhouettes
from psotrack.trajectories import Status, Trajectories

RIG = ring_rig(5, image_size_wh=(1920, 1080))
#: Width and height of a drone, metres.
SPAN_M = (0.4, 0.4)


def positions(time_s, num_drones=2):
    """(..., drones, 3) positions of drones on circles of their own, 1 m/s and faster."""
    time_s = np.asarray(time_s)[..., None]
    turn = np.array([1.1, -0.9, 0.7])[:num_drones] * time_s + np.arange(num_drones)
    rising = 0.3 * np.sin(0.8 * time_s + np.arange(num_drones))
    across = np.array([-1.3, 1.3, 0.0])[:num_drones]
    return np.stack([across + np.cos(turn), np.sin(turn), 1.3 + rising], axis=-1)


def sightings_of(frame_times, *, noise_px=0.3):
    """Boxes of the drones in every frame of each camera, at the frames' own times."""
    most = max(times.num_frames for times in frame_times.values())
    centre_px, size_px = np.full((2, most, len(RIG), 2, 2), np.nan)
    for camera, (name, times) in enumerate(frame_times.items()):
        centre, size = true_boxes(RIG.select([name]), positions(times.time_s), SPAN_M)
        centre_px[: times.num_frames, camera] = centre[:, 0]
        size_px[: times.num_frames, camera] = size[:, 0]
    noise = np.random.default_rng(0).normal(0, noise_px, centre_px.shape)
    stated_px = np.where(np.isfinite(size_px[..., 0]), NOISE_PX, np.nan)
    return Sightings(centre_px + noise, size_px, stated_px)


def alike(num_frames=150, cameras=RIG.names):
    return {name: FrameTimes(num_frames, FPS) for name in cameras}


def exposed_later(frames, num_frames=150):
    """Times of cameras whose frame k was exposed at k + frames[camera]."""
    offsets = zip(RIG.names, frames, strict=True)
    return {name: FrameTimes(num_frames, FPS, number / FPS) for name, number in offsets}


def tracked(timeline, error_s=0.0):
    """True tracks at the instants, shifted in time."""
    time_s, step_s = timeline.time_s + error_s, 1e-4
    velocity = (positions(time_s + step_s) - positions(time_s - step_s)) / (2 * step_s)
    return Trajectories(
        np.arange(len(time_s)),
        timeline.time_s,
        ("0", "1"),
        positions(time_s),
        velocity_m_s=velocity,
        status=np.full((len(time_s), 2), int(Status.TRACKED)),
    )


@given(st.integers(2, 6), st.integers(3, 8), st.integers(0, 1000))
def test_exact_offsets_of_stretches_give_the_exact_clocks(num_cameras, num_stretches, seed):
    """The zero of the offsets differs from stretch to stretch."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(2, 10, num_stretches))
    offset_s, drift = rng.normal(0, 0.05, num_cameras), rng.normal(0, 1e-3, num_cameras)
    zero_s = rng.normal(0, 1, (num_stretches, 1))
    shown = zero_s + offset_s + drift * (time_s - time_s.mean())[:, None]
    found = fit_clocks(time_s, shown, np.full(shown.shape, 1e-7), known_s=0.01)
    np.testing.assert_allclose(found.offset_s, offset_s - np.median(offset_s), atol=1e-9)
    np.testing.assert_allclose(found.drift, drift - np.median(drift), atol=1e-9)


#: Frames by which the clocks of the cameras are off, over the largest.
OFF = np.array([0.0, 1.0, -0.9, 0.35, -0.4])


@pytest.mark.parametrize(("largest", "error_s"), [(0.0, 0.0), (0.8, 0.3 / FPS), (2.0, 0.3 / FPS)])
def test_clocks_that_are_off_by_up_to_two_frames_are_found(largest, error_s):
    """Tracks that are all late or early do not matter; right clocks are left alone."""
    timeline = make_timeline(alike())
    shown = sightings_of(exposed_later(largest * OFF))
    found = clocks_of_tracks(RIG, shown, timeline, tracked(timeline, error_s))
    off_s = found.offset_s - largest * (OFF - np.median(OFF)) / FPS
    off_s -= off_s.mean()
    assert (np.abs(off_s) < 1e-3).all()
    assert (np.abs(off_s) < 4 * found.offset_std_s).all()
    assert (found.offset_std_s < 1e-3).all()
    assert not found.drift.any()
    certain = found.is_certain(0.2 / FPS).sum()
    assert certain >= 3 if largest else certain == 0


def test_a_camera_that_sees_nothing_changes_nothing_for_the_others():
    shown = sightings_of(exposed_later(OFF) | {RIG.names[1]: FrameTimes(0, FPS)})
    timeline = make_timeline(alike())
    found = clocks_of_tracks(RIG, shown, timeline, tracked(timeline))
    others = [0, 2, 3, 4]
    error_s = (found.offset_s - OFF / FPS)[others]
    assert (np.abs(error_s - error_s.mean()) < 1e-3).all()
    assert (found.offset_std_s[others] < 1e-3).all()
    assert (found.offset_s[1], found.offset_std_s[1]) == (0.0, np.inf)
    assert found.known.tolist() == [True, False, True, True, True]
    assert found.record(RIG.names)[RIG.names[1]]["offset_std_s"] is None


def test_a_clock_that_runs_fast_is_found():
    """One camera has 25.1 frames per second, but 25 are given."""
    shown = alike(250) | {RIG.names[2]: FrameTimes(250, 25.1)}
    timeline = make_timeline(alike(250))
    found = clocks_of_tracks(RIG, sightings_of(shown), timeline, tracked(timeline))
    assert found.drift[2] == pytest.approx(25 / 25.1 - 1, abs=3e-4)
    corrected = found.corrected(alike(250), RIG.names)[RIG.names[2]]
    np.testing.assert_allclose(corrected.time_s, shown[RIG.names[2]].time_s, atol=2e-3)


@pytest.mark.parametrize(
    ("cameras", "camera", "frame", "count", "frames"),
    [(5, 4, 170, 3, 300), (2, 1, 130, 1, 300), (2, 0, 130, 1, 300), (5, 0, 70, 1, 140)],
)
def test_lost_frames_are_a_step_at_their_frame_and_no_drift(cameras, camera, frame, count, frames):
    """Found: a line through the offsets, by which most frames were off by up to half the step."""
    rig, number = RIG.select(RIG.names[:cameras]), np.arange(frames)
    given = alike(frames, rig.names)
    lost = {RIG.names[camera]: FrameTimes.listed((number + count * (number >= frame)) / FPS)}
    shown, timeline = sightings_of(alike(frames) | lost), make_timeline(given)
    shown = Sightings(shown.centre_px[:, :cameras], shown.size_px[:, :cameras], shown.noise_px[:, :cameras])
    found = clocks_of_tracks(rig, shown, timeline, tracked(timeline))
    (of_camera,) = found.lost
    assert (of_camera.camera, of_camera.frame, of_camera.count) == (camera, frame, count)
    assert not found.drift.any()
    corrected = found.corrected(given, rig.names)[rig.names[camera]]
    np.testing.assert_allclose(corrected.time_s, lost[rig.names[camera]].time_s, atol=4e-3)
    record = found.record(rig.names)[rig.names[camera]]
    assert record["lost_frames"] == [{"before_frame": frame, "count": count}]


@pytest.mark.parametrize("late", [2.0, -2.0])
def test_a_late_video_is_late_to_the_clocks_to_synchronise_and_in_words(late):
    """Frame k of a video that is late by two frames shows what one that is not late shows in frame k - 2.

    Its frames were exposed earlier than given, as a negative `time_offset_s` says.
    """
    name = RIG.names[3]
    shown = sightings_of(alike() | {name: FrameTimes(150, FPS, -late / FPS)})
    timeline = make_timeline(alike())
    (finding,) = examine(RIG, shown, fps=FPS).findings
    word = "late" if late > 0 else "early"
    assert f" ms {word} (" in finding.message
    _, _, remedy = finding.remedy.partition("add ")
    assert float(remedy.split()[0]) == pytest.approx(-late / FPS, abs=0.1 / FPS)
    record = clocks_of_tracks(RIG, shown, timeline, tracked(timeline)).record(RIG.names)[name]
    assert record["late_s"] == -record["offset_s"] == pytest.approx(late / FPS, abs=0.1 / FPS)
    late_frames = -camera_offsets(RIG, np.swapaxes(shown.centre_px, 1, 2), FPS).offset_frames
    assert late_frames[3] - np.median(late_frames) == pytest.approx(late, abs=0.05)
    # Tracks of videos that are all late have the positions of an earlier time of the reference.
    frame = np.arange(150)
    estimate = Trajectories(frame, frame / FPS, ("0", "1"), positions((frame - late) / FPS))
    reference_s = np.arange(-1.0, 7.0, 0.01)
    offset = find_offset(estimate, reference_s, positions(reference_s), max_offset_s=0.5)
    assert offset.offset_s == pytest.approx(-late / FPS, abs=1e-3)
    said = str(ReferenceOffset("flight", offset, {}, FPS, "world"))
    assert f"the videos show the scene {word};" in said


# --- tracks of cameras with times of their own


def line_tracks(times, given=None):
    """Tracks by projection lines, and the truth, at the instants of the times that are given."""
    timeline = make_timeline(given or times)
    truth_m = positions(timeline.time_s)
    shown = sightings_of(times).at_instants(timeline)
    return track(RIG, shown, known=(truth_m[0], np.zeros((2, 3)))), truth_m


def swarm_tracks(times, given=None):
    """Tracks by the swarm of one drone, whose silhouettes are drawn by casting rays, and the truth."""
    timeline = make_timeline(given or times)
    arrays = []
    for name, each in times.items():
        drawn = draw(near(each.time_s), SIZE_M[:1], DRAWN_RIG.select([name]))
        arrays.append(drawn[:, 0])
    most = max(len(each) for each in arrays)
    silhouettes = Silhouettes(RIG.names, {}, REDUCTION, most, arrays[0].shape[1:], {}, tuple(arrays))
    first_m, later_m = near(np.array([0.0, 1e-3]))
    initial = InitialState(first_m, (later_m - first_m) / 1e-3, SIZE_M[:1], np.array([5.0]))
    shown = silhouettes.at_instants(timeline)
    ((tracks, _),) = track_silhouettes(DRAWN_RIG, shown, [run_inputs(initial)], fps=timeline.rate_hz)
    return tracks, near(timeline.time_s)


def near(time_s):
    """(frames, 1, 3), a drone on a circle in the middle of the room, 1.6 m/s."""
    turn = 1.6 * time_s
    return np.stack([np.cos(turn), np.sin(turn), 1.2 + 0.2 * np.sin(0.7 * turn)], axis=-1)[:, None]


def test_a_drones_place_is_the_middle_of_its_foreground():
    """Sightings with edges in whole cells say where to look, and the foreground says where the drone is."""
    time_s = np.arange(6) / FPS
    position_m = near(time_s)
    velocity_m_s = (near(time_s + 1e-4) - near(time_s - 1e-4)) / 2e-4
    silhouettes = silhouettes_in_memory(DRAWN_RIG, draw(position_m, SIZE_M[:1]), REDUCTION)
    centre_px, size_px = true_boxes(DRAWN_RIG, position_m, SIZE_M[0, 1:])
    sightings = Sightings(np.round(centre_px), size_px, np.full(size_px.shape[:-1], NOISE_PX))
    timeline = make_timeline(alike(6, DRAWN_RIG.names))
    places_px = places_of_tracks(
        DRAWN_RIG.cameras, sightings, timeline, position_m, velocity_m_s, silhouettes
    )
    true_px, _ = project(DRAWN_RIG.cameras, position_m[:, :, None])
    # A quarter of a cell: the middle of an outline of 30 px that perspective bends.
    np.testing.assert_allclose(places_px, true_px, rtol=0, atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tracks_of", "frames"),
    # Interpolated detections: nearly as good as synchronous frames. Silhouettes: measured 0.5 mm worse.
    [(line_tracks, 80), (swarm_tracks, 50)],
)
def test_cameras_that_are_exposed_at_different_times_or_are_slower(tracks_of, frames):
    def figures(times, given=None):
        """Mean error, metres; share of the truths inside the 90 % ellipsoid; share of the instants that are tracked."""
        tracks, truth_m = tracks_of(times, given)
        settled = slice(20, len(truth_m) - 5)
        drones = slice(truth_m.shape[1])
        error_m = (tracks.position_m[:, drones] - truth_m)[settled]
        inverse = np.linalg.inv(tracks.covariance_m2[settled, drones])
        inside = np.einsum("fdi,fdij,fdj->fd", error_m, inverse, error_m) < 6.25
        found = tracks.status[settled, drones] == Status.TRACKED
        return np.linalg.norm(error_m, axis=-1).mean(), inside.mean(), found.mean()

    synchronous_m, _, _ = figures(alike(frames))
    apart = exposed_later([0.0, 0.5, -0.5, 0.25, -0.3], frames)
    error_m, inside, found = figures(apart)
    assert error_m < 1.3 * synchronous_m + 0.0005
    assert inside > 0.7
    assert found == 1.0
    ignored_m, _, _ = figures(apart, alike(frames))
    assert ignored_m > 2 * error_m
    # The slower camera's frames are shown two or three times each and do not shrink the covariance. Another camera
    # starts late and ends early.
    slower = alike(frames) | {
        RIG.names[2]: FrameTimes(frames // 3, 10.0, 0.013),
        RIG.names[1]: FrameTimes(frames // 2, FPS, 0.813),
    }
    error_m, inside, found = figures(slower)
    assert error_m < 1.6 * synchronous_m + 0.001
    assert inside > 0.8
    assert found == 1.0


def test_drones_are_found_by_cameras_with_times_of_their_own():
    times = exposed_later([0.0, 0.5, -0.4, 0.3, -1.2], 12)
    timeline = make_timeline(times).part(slice(10))
    shown = sightings_of(times, noise_px=0.0).at_instants(timeline)

    truth_m = positions(timeline.time_s)
    nobody = KnownDrones(np.empty((0, 3)), np.empty((0, 3)))

    def errors_m(sightings):
        births = Births(RIG.cameras, FlightLimits(FPS, ROOM_M, 6.0))
        for instant in range(sightings.num_frames):
            births.step(instant, sightings[instant], nobody)
        found = births.candidates()
        assert len(found) == 2
        off_m = []
        for one in found:
            for instant, at in one.path.items():
                # Until the velocity is known, the sightings cannot be moved to the instant.
                if instant >= 4:
                    off_m.append(np.linalg.norm(at.position_m - truth_m[instant], axis=-1).min())
        return np.array(off_m)

    exact_m, ignored_m = errors_m(shown), errors_m(replace(shown, exposures=None))
    # Measured 0.3 mm, and 10 mm.
    assert exact_m.max() < 0.002
    assert ignored_m.mean() > 0.005


OFFSET_S = np.array([0.0, 0.02, -0.015, 0.01, 0.0])
LINE_TIME_S = np.array([0.0, 2e-5, 0.0, 1e-5, 3e-5])
NOW = Exposures(OFFSET_S, np.ones(5, bool), np.ones(5), LINE_TIME_S)


def pixels_at_exposure(position_m, velocity_m_s, steps=20):
    """(drones, cameras, 2) pixels of moving drones in rows that are exposed one after the other, by iteration."""
    pixels, _ = project(RIG.cameras, position_m[:, None])
    for _ in range(steps):
        own_s = OFFSET_S + LINE_TIME_S * (pixels[..., 1] - 540)
        pixels, _ = project(RIG.cameras, position_m[:, None] + velocity_m_s[:, None] * own_s[..., None])
    return pixels


def test_boxes_are_where_the_drones_are_when_the_cameras_rows_are_exposed():
    rng = np.random.default_rng(4)
    position_m = rng.uniform(-1, 1, (3, 3)) + np.array([0, 0, 1.5])
    velocity_m_s = rng.normal(0, 1.5, (3, 3))
    exposures = replace(NOW, is_there=np.array([True, True, True, False, True]))

    @jax.jit
    def boxes_at(exposures, cameras):
        extents = make_extents(exposures.seeing(cameras), np.full((3, 3), 0.02))
        return project_boxes(exposures.moved(extents, position_m, velocity_m_s), position_m)

    with jax.enable_x64(True):
        boxes = boxes_at(exposures, RIG.cameras)
    middle_px = np.stack([boxes.x_middle, boxes.y_middle], axis=-1) - 0.5
    assert np.isfinite(middle_px).all()
    assert not np.asarray(boxes.in_front)[:, 3].any()
    seen = [0, 1, 2, 4]
    # The row is that of the expected position, which differs little from that of the moved one.
    one_step = pixels_at_exposure(position_m, velocity_m_s, steps=1)
    np.testing.assert_allclose(middle_px[:, seen], one_step[:, seen], atol=0.05)
    at_exposure = pixels_at_exposure(position_m, velocity_m_s)
    np.testing.assert_allclose(middle_px[:, seen], at_exposure[:, seen], atol=1.0)


def test_a_rolling_shutter_has_the_time_of_its_middle_row():
    videos = {name: VideoInfo(Path(f"{name}.avi"), 20, FPS, (1920, 1080)) for name in RIG.names}
    recording = Recording("r", Path("r"), cameras_of(RIG, video=videos))
    assert recording.timeline().is_synchronous
    rolling = with_cameras(recording, line_time_s={RIG.names[1]: 2e-5}).timeline()
    assert not rolling.is_synchronous
    assert rolling.line_time_s.tolist() == [0, 2e-5, 0, 0, 0]
    for offset_s in rolling.offset_s[:20]:
        np.testing.assert_allclose(offset_s, [0, 0.0108, 0, 0, 0], atol=1e-9)
