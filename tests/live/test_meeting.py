"""Frames of live cameras meet by their times: the nearest frame of each camera at each instant, whatever is lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.live import Instant, Meeting
from psotrack.recordings import FrameTimes, make_timeline

WAIT_S = 0.1


def _image(number: int) -> np.ndarray:
    """A silhouette that tells the number of its frame."""
    return np.array([[number % 256, number // 256]], np.uint8)


def _number(image: np.ndarray | None) -> int:
    return -1 if image is None else int(image[0, 0]) + 256 * int(image[0, 1])


def _put(meeting: Meeting, camera: int, number: int, time_s: float, now_s: float) -> bool:
    is_back = meeting.announce(camera, time_s, now_s)
    meeting.put(camera, time_s, _image(number), now_s)
    return is_back


def _meeting(count: int = 3, fps: float = 25.0) -> Meeting:
    meeting = Meeting([fps] * count, fps, wait_s=WAIT_S)
    meeting.began_s = 0.0
    return meeting


def _all(meeting: Meeting, now_s: float) -> list[Instant]:
    taken = []
    while (instant := meeting.take(now_s)) is not None:
        taken.append(instant)
    return taken


@given(
    rates=st.lists(st.sampled_from([25.0, 30.0, 50.0, 12.5, 24.0]), min_size=2, max_size=4),
    offsets=st.lists(st.integers(0, 40), min_size=4, max_size=4),
    data=st.data(),
)
def test_frames_meet_as_on_the_timeline_of_a_recording(
    rates: list[float], offsets: list[int], data: st.DataObject
) -> None:
    """Frames that come in the order of their times, those of equal times in any order, and none lost."""
    times = {
        f"c{index}": FrameTimes(round(rate), rate, offsets[index] / 1000) for index, rate in enumerate(rates)
    }
    timeline = make_timeline(times)
    meeting = Meeting(rates, timeline.rate_hz, wait_s=WAIT_S, first_s=float(timeline.time_s[0]))
    coming = [
        (time_s, camera, number)
        for camera, each in enumerate(times.values())
        for number, time_s in enumerate(each.time_s.tolist())
    ]
    coming = sorted(data.draw(st.permutations(coming)), key=lambda frame: frame[0])
    taken: list[Instant] = []
    for time_s, camera, number in coming:
        _put(meeting, camera, number, time_s, time_s)
        taken += _all(meeting, time_s)
    for camera in range(len(rates)):
        meeting.end(camera)
    taken += _all(meeting, np.inf)
    shown = {instant.number: instant for instant in taken}
    for instant in range(timeline.num_instants):
        if not timeline.is_there[instant].any():
            assert instant not in shown
            continue
        found = shown[instant]
        assert found.time_s == pytest.approx(timeline.time_s[instant])
        numbers = [_number(image) for image in found.coverage]
        # Two frames that are equally near may both be meant: the times differ in their last digits only.
        for camera, number in enumerate(numbers):
            expected = timeline.frame[instant, camera]
            if number != expected:
                apart = abs(abs(found.offset_s[camera]) - abs(timeline.offset_s[instant, camera]))
                assert apart < 1e-9
                assert -1 not in (number, expected)
    assert all(camera.counts.late == camera.counts.doubled == 0 for camera in meeting.cameras)


def test_an_instant_waits_for_a_frame_and_not_for_ever() -> None:
    meeting = _meeting()
    _put(meeting, 0, 0, 0.0, 10.0)
    _put(meeting, 1, 0, 0.001, 10.01)
    assert meeting.take(10.05) is None
    instant = meeting.take(10.11)
    assert instant is not None
    assert [_number(image) for image in instant.coverage] == [0, 0, -1]
    np.testing.assert_allclose(instant.offset_s, [0, 0.001, 0])
    assert instant.arrived_s == 10.01
    # The third camera's frame comes when its instant is over.
    _put(meeting, 2, 0, 0.0, 10.2)
    assert meeting.cameras[2].counts.late == 1
    assert meeting.cameras[2].counts.missing == 1


@pytest.mark.parametrize(
    ("ends", "shown", "left_out"),
    [
        (lambda meeting: meeting.put(1, 0.0, _image(0), 0.0), 0, 0),
        (lambda meeting: meeting.put(1, 0.0, None, 0.0), -1, 1),
        # A camera whose frame fails in work ends: its instant waited for ever.
        (lambda meeting: meeting.end(1), -1, 0),
    ],
)
def test_an_instant_waits_for_a_frame_that_is_in_work(ends, shown: int, left_out: int) -> None:
    meeting = _meeting(2)
    _put(meeting, 0, 0, 0.0, 0.0)
    meeting.announce(1, 0.0, 0.0)
    assert meeting.has_work
    assert meeting.take(5.0) is None
    ends(meeting)
    assert not meeting.has_work
    instant = meeting.take(0.0)
    assert instant is not None
    assert [_number(image) for image in instant.coverage] == [0, shown]
    assert meeting.cameras[1].counts.left_out == left_out


def test_a_doubled_frame_counts_once() -> None:
    meeting = _meeting(2)
    for camera in (0, 1, 1):
        _put(meeting, camera, 0, 0.0, 0.0)
    instant = meeting.take(0.0)
    assert instant is not None
    assert meeting.cameras[1].counts.doubled == 1
    assert meeting.take(1.0) is None


def test_a_camera_that_stops_is_not_waited_for_and_comes_back() -> None:
    meeting = _meeting()
    for frame in range(100):
        at_s = frame / 25
        for camera in (0, 1, 2):
            if camera == 2 and 25 <= frame < 75:
                continue
            assert _put(meeting, camera, frame, at_s, at_s) == (camera == 2 and frame == 75)
        stopped = meeting.stopped(at_s)
        # A second after its last frame, and once.
        assert stopped == ([2] if frame == 50 else [])
        wait_s = WAIT_S if 25 <= frame < 50 else 0.0
        (instant,) = _all(meeting, at_s + wait_s)
        assert instant.number == frame
        assert [image is not None for image in instant.coverage] == [True, True, not 25 <= frame < 75]
    counts = meeting.cameras[2].counts
    assert (counts.stops, counts.frames, counts.late) == (1, 50, 0)
    assert all(camera.films for camera in meeting.cameras)


def test_a_camera_that_begins_late_has_not_stopped() -> None:
    meeting = _meeting(2)
    _put(meeting, 0, 0, 1.1, 1.1)
    assert meeting.stopped(1.2) == [1]
    assert [camera.films for camera in meeting.cameras] == [True, False]
    assert _put(meeting, 1, 1, 2.0, 2.0)
    assert meeting.cameras[1].films
    assert meeting.cameras[1].counts.stops == 0
    assert meeting.stopped(3.5) == [0, 1]
    assert [camera.counts.stops for camera in meeting.cameras] == [1, 1]


@pytest.mark.parametrize("drift", [-3e-3, 3e-3])
def test_a_clock_that_drifts_drops_or_doubles_a_frame_at_times(drift: float) -> None:
    meeting = _meeting(2)
    shown = []
    coming = sorted(
        [(frame / 25, 0, frame) for frame in range(400)]
        + [(frame / 25 * (1 + drift), 1, frame) for frame in range(400)]
    )
    for time_s, camera, number in coming:
        _put(meeting, camera, number, time_s, time_s)
        shown += _all(meeting, time_s)
    numbers = np.array([_number(instant.coverage[1]) for instant in shown])
    assert (numbers >= 0).all()
    offsets_s = np.array([instant.offset_s[1] for instant in shown])
    # Never farther than half an interval, and after 400 frames a frame apart.
    assert np.abs(offsets_s).max() <= 0.5 / 25 * (1 + abs(drift)) + 1e-9
    apart = numbers - np.arange(len(numbers))
    assert apart[0] == 0
    assert apart[-1] == (-1 if drift > 0 else 1)
    assert meeting.cameras[1].counts.stops == 0


def test_the_meeting_ends_when_all_cameras_have() -> None:
    meeting = _meeting(2)
    _put(meeting, 0, 0, 0.0, 0.0)
    meeting.end(1)
    assert not meeting.has_ended
    meeting.end(0)
    assert len(_all(meeting, 0.0)) == 1
    assert meeting.has_ended
