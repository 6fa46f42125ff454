"""Recordings: frames of all cameras meet at the instants of one clock, and `usable` accepts what belongs together."""

import numpy as np
import pytest
from dpjait_folders import LETTERS, full_hd_recording
from helpers import with_cameras
from hypothesis import assume, given
from hypothesis import strategies as st

from psotrack.recordings import FrameTimes, make_timeline

# --- frames at instants


# The strategies draw plain numbers: the runtime type checks draw random numbers of their own, which hypothesis forbids.
regular = st.tuples(
    st.integers(1, 40), st.sampled_from([12.5, 24.0, 25.0, 29.97, 30.0, 50.0, 100.0]), st.floats(-0.3, 0.5)
)
steps = st.lists(st.floats(0.005, 0.2), min_size=1, max_size=30)
one_camera = regular | steps
cameras = st.lists(one_camera, min_size=1, max_size=4)


def times_of(drawn):
    """Frame times of a drawn camera: number of frames, rate and start, or steps from time to time."""
    if isinstance(drawn, tuple):
        return FrameTimes(*drawn)
    return FrameTimes.listed(np.cumsum([0.1, *drawn]))


@given(cameras, st.sampled_from([None, 10.0, 25.0, 60.0]))
def test_each_instant_shows_the_nearest_frame_of_each_camera_or_none(drawn, rate_hz):
    frame_times = {f"camera{number}": times_of(each) for number, each in enumerate(drawn)}
    # Some frame is near an instant from time 0 on: two frames that are close together may lie between two instants.
    instants_hz = rate_hz or max(times.fps for times in frame_times.values())
    near = False
    for times in frame_times.values():
        time_s = times.time_s[times.time_s >= 0]
        apart_s = np.abs(time_s - np.rint(time_s * instants_hz) / instants_hz)
        near |= (apart_s * times.fps <= 0.5).any()
    assume(near)
    timeline = make_timeline(frame_times, rate_hz)
    assert timeline.is_there.any(axis=1)[-1]
    for camera, times in enumerate(frame_times.values()):
        apart_s = np.abs(times.time_s - timeline.time_s[:, None])
        nearest_s = apart_s.min(axis=1)
        there = timeline.is_there[:, camera]
        frame, share = timeline.frame[there, camera], timeline.share[:, camera]
        # Differences below a millionth of an interval count as rounding.
        used_s = times.time_s[frame]
        assert np.allclose(timeline.offset_s[there, camera], used_s - timeline.time_s[there], atol=2e-7)
        assert np.allclose(np.abs(timeline.offset_s[there, camera]), nearest_s[there], atol=2e-7)
        assert (nearest_s[there] * times.fps <= 0.6 + 1e-6).all()
        assert (nearest_s[~there] * times.fps >= 0.5).all()
        assert not timeline.offset_s[~there, camera].any()
        # The shares of each frame that is shown sum to 1.
        sums = np.bincount(frame, share[there])
        assert np.allclose(sums[np.unique(frame)], 1.0)
        assert not share[~there].any()


@given(one_camera, st.integers(1, 4))
def test_frame_i_of_equal_cameras_is_instant_i(drawn, num_cameras):
    times = times_of(drawn)
    if times.time_s[0] < 0:
        times = times.corrected(-times.time_s[0])
    timeline = make_timeline({f"{number}": times for number in range(num_cameras)})
    assert timeline.is_synchronous
    assert timeline.time_s.tolist() == times.time_s.tolist()
    assert (timeline.share == 1).all()


@given(one_camera, st.floats(-2, 2), st.floats(-0.01, 0.01))
def test_corrected_times(drawn, offset_s, drift):
    times = times_of(drawn)
    corrected = times.corrected(offset_s, drift)
    assert np.allclose(corrected.time_s, times.time_s * (1 + drift) + offset_s, atol=1e-9)


#: Name of the case -> times of two cameras, rate of the instants, frames of both, offsets of the second in seconds.
TIMELINES = {
    "a slower camera": (
        (FrameTimes(8, 40.0), FrameTimes(2, 10.0)),
        None,
        [[0, 0], [1, 0], [2, 0], [3, 1], [4, 1], [5, 1], [6, 1], [7, -1]],
        [0, -0.025, -0.05, 0.025, 0, -0.025, -0.05, 0],
    ),
    "a dropped frame": (
        (FrameTimes(6, 10.0), FrameTimes.listed(np.array([0.0, 0.1, 0.2, 0.4, 0.5]))),
        None,
        [[0, 0], [1, 1], [2, 2], [3, -1], [4, 3], [5, 4]],
        [0] * 6,
    ),
    "another rate": ((FrameTimes(5, 10.0), FrameTimes(5, 10.0)), 5.0, [[0, 0], [2, 2], [4, 4]], [0, 0, 0]),
}


@pytest.mark.parametrize(("times", "rate_hz", "frame", "offset_s"), TIMELINES.values(), ids=TIMELINES)
def test_timelines_by_hand(times, rate_hz, frame, offset_s):
    timeline = make_timeline(dict(zip("ab", times, strict=True)), rate_hz)
    rate_hz = rate_hz or max(each.fps for each in times)
    assert timeline.rate_hz == rate_hz
    assert timeline.time_s == pytest.approx(np.arange(len(frame)) / rate_hz)
    assert timeline.frame.tolist() == frame
    assert timeline.offset_s[:, 1] == pytest.approx(offset_s)
    assert not timeline.offset_s[:, 0].any()
    assert not timeline.is_synchronous


# --- what belongs together


def test_a_camera_without_video_is_left_out_with_a_warning(caplog):
    # Rates that differ by rounding are equal.
    recording = full_hd_recording(b=None, c={"fps": 25.00004}, d=None)
    usable = recording.usable()
    assert usable.rig.names == tuple(usable.videos) == ("a", "c", "e")
    assert usable.num_frames == 250
    assert caplog.messages == [f"camera {name} is left out: it has no video" for name in "bd"]
    assert recording.usable(["c", "a"]).rig.names == ("c", "a")
    assert recording.usable("c").rig.names == ("c",)
    # A camera with times alone counts where no videos are needed.
    timed = with_cameras(recording, times={"b": FrameTimes(30, 25.0)})
    assert timed.usable(videos=False).rig.names == ("a", "b", "c", "e")
    assert timed.usable(["b"], videos=False).num_frames == 30
    assert full_hd_recording(**dict.fromkeys(LETTERS)).num_frames == 0


def test_leading_frames_of_a_slow_camera_and_of_one_that_begins_later(caplog):
    recording = with_cameras(
        full_hd_recording(b={"fps": 50.0}),
        times={"c": FrameTimes(250, 25.0, 0.8), "d": FrameTimes(250, 25.0, 3.0)},
    ).usable(num_frames=100)
    # 100 instants at 50 Hz are 2 s.
    counts = {name: video.num_frames for name, video in recording.videos.items()}
    assert counts == {"a": 50, "b": 100, "c": 30, "e": 50}
    assert {each.name: each.times.num_frames for each in recording.cameras} == counts
    assert recording.num_frames == 100
    assert "camera d is left out: it has no frame before instant 100" in caplog.text
    shorter = full_hd_recording(c={"num_frames": 240}).usable(num_frames=240)
    assert {video.num_frames for video in shorter.videos.values()} == {240}
