"""Frames of cameras with clocks, rates and lengths of their own meet at the instants of one clock."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.errors import InputError, SettingsError
from psotrack.recordings import FrameTimes, make_timeline

# The strategies draw plain numbers: the runtime type checks draw random numbers of their own, which hypothesis forbids.
regular = st.tuples(
    st.integers(1, 40),
    st.sampled_from([12.5, 24.0, 25.0, 29.97, 30.0, 50.0, 100.0]),
    st.floats(-0.3, 0.5),
)
steps = st.lists(st.floats(0.005, 0.2), min_size=1, max_size=30)
one_camera = regular | steps
cameras = st.lists(one_camera, min_size=1, max_size=4)


def times_of(drawn) -> FrameTimes:
    """Frame times of a drawn camera: number of frames, rate and start, or steps from time to time."""
    if isinstance(drawn, tuple):
        return FrameTimes(*drawn)
    return FrameTimes.listed(np.cumsum([0.1, *drawn]))


def times_of_all(drawn) -> dict[str, FrameTimes]:
    return {f"camera{number}": times_of(each) for number, each in enumerate(drawn)}


@given(cameras, st.sampled_from([None, 10.0, 25.0, 60.0]))
@settings(max_examples=60, deadline=None)
def test_each_instant_shows_the_nearest_frame_of_each_camera_or_none(drawn, rate_hz):
    frame_times = times_of_all(drawn)
    try:
        timeline = make_timeline(frame_times, rate_hz)
    except InputError:
        assert all(times.time_s[-1] < 1e-6 + 0.6 / times.fps for times in frame_times.values())
        return
    assert timeline.is_there.any(axis=1)[-1]
    for camera, times in enumerate(frame_times.values()):
        apart_s = np.abs(times.time_s - timeline.time_s[:, None])
        nearest_s = apart_s.min(axis=1)
        there = timeline.is_there[:, camera]
        used_s = times.time_s[timeline.frame[there, camera]]
        assert np.allclose(timeline.offset_s[there, camera], used_s - timeline.time_s[there], atol=2e-7)
        assert np.allclose(np.abs(timeline.offset_s[there, camera]), nearest_s[there], atol=2e-7)
        assert (nearest_s[there] * times.fps <= 0.6 + 1e-6).all()
        assert (nearest_s[~there] * times.fps >= 0.5).all()
        assert not timeline.offset_s[~there, camera].any()


@given(cameras, st.sampled_from([None, 10.0, 60.0]))
@settings(max_examples=40, deadline=None)
def test_the_shares_of_each_frame_that_is_shown_sum_to_1(drawn, rate_hz):
    try:
        timeline = make_timeline(times_of_all(drawn), rate_hz)
    except InputError:
        return
    for frame, share in zip(timeline.frame.T, timeline.share.T, strict=True):
        sums = np.bincount(frame[frame >= 0], share[frame >= 0])
        assert np.allclose(sums[np.unique(frame[frame >= 0])], 1.0)
        assert not share[frame < 0].any()


@given(one_camera, st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_frame_i_of_equal_cameras_is_instant_i(drawn, num_cameras):
    times = times_of(drawn)
    if times.time_s[0] < 0:
        times = times.corrected(-times.time_s[0])
    timeline = make_timeline({f"{number}": times for number in range(num_cameras)})
    assert timeline.is_synchronous
    assert timeline.time_s.tolist() == times.time_s.tolist()
    assert (timeline.share == 1).all()


def test_instants_before_time_0_are_left_out():
    timeline = make_timeline({"a": FrameTimes(5, 10.0, -0.2), "b": FrameTimes(5, 10.0, -0.2)})
    assert timeline.frame[:, 0].tolist() == [2, 3, 4]
    assert timeline.time_s == pytest.approx([0, 0.1, 0.2])
    assert not timeline.offset_s.any()


def test_a_camera_that_starts_late_and_one_that_ends_early():
    timeline = make_timeline({"a": FrameTimes(4, 10.0), "b": FrameTimes(4, 10.0, 0.23)})
    assert timeline.frame.tolist() == [[0, -1], [1, -1], [2, 0], [3, 1], [-1, 2], [-1, 3]]
    assert timeline.offset_s[2:, 1] == pytest.approx([0.03] * 4)
    assert not timeline.is_synchronous


def test_a_shorter_camera_of_the_same_clock_is_absent_at_the_end():
    timeline = make_timeline({"a": FrameTimes(3, 25.0), "b": FrameTimes(1, 25.0)})
    assert timeline.frame.tolist() == [[0, 0], [1, -1], [2, -1]]
    assert not timeline.offset_s.any()


def test_a_slower_camera_shows_each_frame_at_several_instants():
    timeline = make_timeline({"fast": FrameTimes(8, 40.0), "slow": FrameTimes(2, 10.0)})
    assert timeline.rate_hz == 40.0
    assert timeline.frame[:, 1].tolist() == [0, 0, 0, 1, 1, 1, 1, -1]
    assert timeline.share[:, 1] == pytest.approx([1 / 3] * 3 + [1 / 4] * 4 + [0])
    assert timeline.offset_s[:, 1] == pytest.approx([0, -0.025, -0.05, 0.025, 0, -0.025, -0.05, 0])


def test_a_dropped_frame_is_not_there():
    times = FrameTimes.listed(np.array([0.0, 0.1, 0.2, 0.4, 0.5]))
    timeline = make_timeline({"a": times, "b": FrameTimes(6, 10.0)})
    assert timeline.frame[:, 0].tolist() == [0, 1, 2, -1, 3, 4]


def test_another_rate():
    timeline = make_timeline({"a": FrameTimes(10, 10.0)}, 5.0)
    assert timeline.frame[:, 0].tolist() == [0, 2, 4, 6, 8]


@given(one_camera, st.floats(-2, 2), st.floats(-0.01, 0.01))
@settings(max_examples=40, deadline=None)
def test_corrected_times(drawn, offset_s, drift):
    times = times_of(drawn)
    corrected = times.corrected(offset_s, drift)
    assert np.allclose(corrected.time_s, times.time_s * (1 + drift) + offset_s, atol=1e-9)


@pytest.mark.parametrize("fps", [0.0, -25.0, np.nan, np.inf])
def test_a_rate_that_is_not_above_0_is_refused(fps):
    with pytest.raises(SettingsError, match="fps: expected a number above 0"):
        FrameTimes(10, fps)
    with pytest.raises(SettingsError, match="rate: expected a number above 0"):
        make_timeline({"a": FrameTimes(10, 25.0)}, fps)


def test_times_that_go_back_are_refused():
    with pytest.raises(
        InputError, match=r"left_times.csv: expected times that increase.*found 0.1 s for frame 2"
    ):
        FrameTimes.listed(np.array([0.0, 0.2, 0.1]), where="left_times.csv")
    with pytest.raises(InputError, match="found nan s for frame 1"):
        FrameTimes.listed(np.array([0.0, np.nan, 0.1]))
    with pytest.raises(InputError, match="expected times of at least 2 frames, found 1"):
        FrameTimes.listed(np.array([0.0]))


def test_no_frame_from_time_0_on():
    with pytest.raises(InputError, match="expected a camera with a frame at time 0 s or later"):
        make_timeline({"a": FrameTimes(10, 25.0, -1.0)})
