"""Frames of live cameras: streams bring them with their times, they meet at instants, and what is filmed is kept."""

import shutil
import threading
from operator import itemgetter

import cv2
import numpy as np
import pytest
from helpers import assert_refused, cameras_of, files_up_to, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from small_sweeps import wait_until

from psotrack.live import CameraRecorder, Meeting, StreamClock, recording_folder
from psotrack.recordings import FrameTimes, Recording, VideoEncoder, make_timeline, probe, read_frames
from psotrack.recordings.datasets import open_recording

FPS = 25.0
WAIT_S = 0.1
#: Size of the images that are recorded.
SIZE_WH = (320, 240)
RIG = ring_rig(3, image_size_wh=SIZE_WH)


# --- times


def clock_times(stream_s, arrived_s):
    """The times of a stream's frames, and whether the stream's own times are used."""
    clock = StreamClock()
    times_s, is_used = [], []
    for of_stream_s, of_arrival_s in zip(stream_s.tolist(), arrived_s.tolist(), strict=True):
        times_s.append(clock.time_s(of_stream_s, of_arrival_s))
        is_used.append(clock.is_used)
    return np.array(times_s), is_used


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
def test_jitter_is_removed_from_the_times_of_a_stream(drift):
    rng = np.random.default_rng(0)
    filmed_s = 1000 + np.arange(1000) / FPS
    arrived_s = np.maximum.accumulate(filmed_s + 0.08 + rng.exponential(0.02, len(filmed_s)))
    times_s, is_used = clock_times((filmed_s - 1000) * (1 + drift), arrived_s)
    used = np.array([each is True for each in is_used])
    assert used[-1]
    assert used.mean() > 0.85
    expected_s = filmed_s + 0.08
    # The least lateness of 50 frames is 0.4 ms in the mean; and clocks that are 1e-4 apart move by 0.4 ms in 4 s.
    assert np.abs(times_s - expected_s)[used].max() < 0.004
    assert np.abs(arrived_s - expected_s)[used].max() > 0.05


def test_times_that_are_no_times_of_this_clock_are_not_used():
    number = np.arange(500)
    arrived_s = 1000 + number / FPS
    no_times_s = np.zeros(500)
    # FFmpeg invents times of another rate.
    invented_s = number / 30
    going_back_s = np.where(number % 3 == 2, number - 2, number) / FPS
    for stream_s in (no_times_s, invented_s, going_back_s):
        times_s, is_used = clock_times(stream_s, arrived_s)
        assert is_used[-1] is False
        np.testing.assert_array_equal(times_s, arrived_s)


def test_a_frame_that_the_stream_does_not_count_is_noticed():
    """Invented times of the right rate fall behind by an interval with each frame that the camera drops."""
    number = np.delete(np.arange(750), 400)
    arrived_s = 1000 + number / FPS
    times_s, is_used = clock_times(np.arange(749) / FPS, arrived_s)
    assert {True, False} <= set(is_used)
    assert is_used[-1] is True
    # Until the block ends, two seconds at most, and the one before is over.
    wrong = np.abs(times_s - arrived_s) > 1e-6
    assert wrong.sum() <= 2 * 2 * FPS
    assert not wrong[-1]


# --- instants


def _image(number):
    """A silhouette that tells the number of its frame."""
    return np.array([[number % 256, number // 256]], np.uint8)


def _number(image):
    return -1 if image is None else int(image[0, 0]) + 256 * int(image[0, 1])


def _put(meeting, camera, number, time_s, now_s):
    is_back = meeting.announce(camera, time_s, now_s)
    meeting.put(camera, time_s, _image(number), now_s)
    return is_back


def _meeting(count=3, fps=25.0):
    meeting = Meeting([fps] * count, fps, wait_s=WAIT_S)
    meeting.began_s = 0.0
    return meeting


def _all(meeting, now_s):
    taken = []
    while (instant := meeting.take(now_s)) is not None:
        taken.append(instant)
    return taken


@given(
    rates=st.lists(st.sampled_from([25.0, 30.0, 50.0, 12.5, 24.0]), min_size=2, max_size=4),
    offsets=st.lists(st.integers(0, 40), min_size=4, max_size=4),
    data=st.data(),
)
def test_frames_meet_as_on_the_timeline_of_a_recording(rates, offsets, data):
    """Frames that come in the order of their times, those of equal times in any order, and none lost."""
    times, coming = {}, []
    for camera, rate in enumerate(rates):
        filmed = FrameTimes(round(rate), rate, offsets[camera] / 1000)
        times[f"c{camera}"] = filmed
        coming += [(time_s, camera, number) for number, time_s in enumerate(filmed.time_s.tolist())]
    timeline = make_timeline(times)
    meeting = Meeting(rates, timeline.rate_hz, wait_s=WAIT_S, first_s=float(timeline.time_s[0]))
    shuffled = data.draw(st.permutations(coming))
    taken = []
    for time_s, camera, number in sorted(shuffled, key=itemgetter(0)):
        _put(meeting, camera, number, time_s, time_s)
        taken += _all(meeting, time_s)
    for camera in range(len(rates)):
        meeting.end(camera)
    taken += _all(meeting, np.inf)
    is_filmed = timeline.is_there.any(axis=1)
    assert [instant.number for instant in taken] == np.flatnonzero(is_filmed).tolist()
    for instant in taken:
        assert instant.time_s == pytest.approx(timeline.time_s[instant.number])
        expected = timeline.frame[instant.number]
        offset_s = timeline.offset_s[instant.number]
        for camera, image in enumerate(instant.coverage):
            number = _number(image)
            if number != expected[camera]:
                # Two frames are equally near: the times differ in their last digits only.
                assert abs(abs(instant.offset_s[camera]) - abs(offset_s[camera])) < 1e-9
                assert -1 not in (number, expected[camera])
    for camera in meeting.cameras:
        assert camera.counts.late == camera.counts.doubled == 0


def test_an_instant_waits_for_a_frame_and_not_for_ever():
    meeting = _meeting()
    _put(meeting, 0, 0, 0.0, 10.0)
    _put(meeting, 1, 0, 0.001, 10.01)
    assert meeting.take(10.05) is None
    instant = meeting.take(10.11)
    assert [_number(image) for image in instant.coverage] == [0, 0, -1]
    np.testing.assert_allclose(instant.offset_s, [0, 0.001, 0])
    assert instant.arrived_s == 10.01
    # The third camera's frame comes when its instant is over.
    _put(meeting, 2, 0, 0.0, 10.2)
    assert meeting.cameras[2].counts.late == 1
    assert meeting.cameras[2].counts.missing == 1


@pytest.mark.parametrize(
    ("becomes", "shown", "left_out"), [("put", 0, 0), ("left out", -1, 1), ("ended", -1, 0)]
)
def test_an_instant_waits_for_a_frame_that_is_in_work(becomes, shown, left_out):
    meeting = _meeting(2)
    _put(meeting, 0, 0, 0.0, 0.0)
    meeting.announce(1, 0.0, 0.0)
    assert meeting.take(5.0) is None
    if becomes == "ended":
        # A camera whose frame fails in work ends: its instant waited for ever.
        meeting.end(1)
    else:
        meeting.put(1, 0.0, _image(0) if becomes == "put" else None, 0.0)
    assert [_number(image) for image in meeting.take(0.0).coverage] == [0, shown]
    assert meeting.cameras[1].counts.left_out == left_out


def test_a_doubled_frame_counts_once_and_the_meeting_ends_when_all_cameras_have():
    meeting = _meeting(2)
    for camera in (0, 1, 1):
        _put(meeting, camera, 0, 0.0, 0.0)
    assert len(_all(meeting, 0.0)) == 1
    assert meeting.cameras[1].counts.doubled == 1
    _put(meeting, 0, 1, 0.04, 2.0)
    meeting.end(1)
    assert not meeting.has_ended
    meeting.end(0)
    assert len(_all(meeting, 2.0)) == 1
    assert meeting.has_ended


def test_a_camera_that_stops_is_not_waited_for_and_comes_back():
    meeting = _meeting()
    came_back, stopped = [], []
    for frame in range(100):
        at_s = frame / 25
        films = not 25 <= frame < 75
        for camera in (0, 1, 2) if films else (0, 1):
            if _put(meeting, camera, frame, at_s, at_s):
                came_back.append((frame, camera))
        for camera in meeting.stopped(at_s):
            stopped.append((frame, camera))
        wait_s = WAIT_S if 25 <= frame < 50 else 0.0
        (instant,) = _all(meeting, at_s + wait_s)
        assert instant.number == frame
        assert [image is not None for image in instant.coverage] == [True, True, films]
    # A second after its last frame, and once.
    assert stopped == [(50, 2)]
    assert came_back == [(75, 2)]
    counts = meeting.cameras[2].counts
    assert counts.stops == 1
    assert counts.frames == 50
    assert counts.late == 0


# --- what is kept


@pytest.fixture
def laboratory(tmp_path):
    """Three cameras on the network, with bounds, an image of what is ignored, and a rolling shutter."""
    ignore = tmp_path / "trees.png"
    cv2.imwrite(f"{ignore}", np.zeros(SIZE_WH[::-1], np.uint8))
    return Recording(
        "laboratory",
        tmp_path / "laboratory",
        cameras_of(
            RIG,
            stream={name: f"rtsp://camera/{name}" for name in RIG.names},
            ignore={RIG.names[0]: ignore},
            line_time_s={RIG.names[1]: 1e-5},
        ),
        bounds_m=(-1.0, 1.0, -2.0, 2.0, 0.0, 3.0),
    )


def noise(index):
    width, height = SIZE_WH
    return np.random.default_rng(index).integers(0, 255, (height, width, 3), dtype=np.uint8)


def record(recorder, images, first=0):
    """Record frames at 25 Hz, as fast as they are encoded."""
    times = recorder.times
    for count, image in enumerate(images, start=1):
        recorder.write(image, (first + count - 1) / FPS)
        # The row of a frame is written just before it is encoded.
        wait_until(lambda count=count: times.exists() and times.read_text().count("\n") > count)


def test_what_was_filmed_is_a_recording(laboratory, tmp_path):
    """One camera starts later, and another one never films."""
    folder = tmp_path / "flight"
    width, height = SIZE_WH
    filmed = {RIG.names[0]: range(30), RIG.names[1]: range(5, 25), RIG.names[2]: range(0)}
    with recording_folder(folder, laboratory, RIG.names):
        for name, numbers in filmed.items():
            recorder = CameraRecorder(folder, name, FPS)
            images = [np.full((height, width, 3), 2 * number, np.uint8) for number in numbers]
            record(recorder, images, first=numbers.start)
            assert vars(recorder.close()) == {"frames": len(numbers), "left_out": 0}
    found = open_recording(folder / "recording.toml")
    assert found.rig.names == RIG.names[:2]
    assert np.allclose(found.rig.cameras.T_cam_world, RIG.cameras.T_cam_world[:2], atol=1e-6)
    assert found.bounds_m == laboratory.bounds_m
    first, second = found.cameras
    assert first.ignore is not None
    assert second.ignore is None
    assert first.line_time_s == 0.0
    assert second.line_time_s == 1e-5
    for camera in found.cameras:
        numbers = np.array(filmed[camera.name])
        # Not rounded: what meets live shall meet again.
        np.testing.assert_array_equal(camera.times.time_s, numbers / FPS)
        levels = [frame.mean() for frame in read_frames(camera.video)]
        # The codec changes the level of flat frames by up to 3.7 of 255, as the tests of videos say.
        np.testing.assert_allclose(levels, 2 * numbers, rtol=0, atol=3.7)


def test_a_frame_that_comes_twice_is_kept_once(tmp_path):
    recorder = CameraRecorder(tmp_path, "cam1", FPS)
    for time_s in (0.0, 0.04, 0.04, 0.02, 0.08):
        recorder.write(noise(0), time_s)
    assert vars(recorder.close()) == {"frames": 3, "left_out": 0}
    # The times are exact.
    assert recorder.times.read_text() == "frame,time_s\n0,0.0\n1,0.04\n2,0.08\n"


def test_nobody_waits_for_the_codec(tmp_path, monkeypatch, caplog):
    """While the codec is busy, frames are left out and counted, and this is said once."""
    is_free, encode = threading.Event(), VideoEncoder.write

    def wait(encoder, image):
        is_free.wait()
        encode(encoder, image)

    monkeypatch.setattr(VideoEncoder, "write", wait)
    recorder = CameraRecorder(tmp_path, "cam1", FPS)
    for index in range(50):
        recorder.write(noise(index), index / FPS)
    is_free.set()
    counts = recorder.close()
    assert counts.frames + counts.left_out == 50
    # Those that wait, and the one that is encoded.
    assert counts.frames in (8, 9)
    said = f"{tmp_path}: frames are left out of the recording, because the computer is too slow"
    assert caplog.messages == [said]


def test_a_crash_leaves_what_was_recorded(laboratory, tmp_path):
    """What is in the files before the recording ends is what a killed process leaves."""
    folder, name = tmp_path / "flight", RIG.names[0]
    with recording_folder(folder, laboratory, [name]):
        recorder = CameraRecorder(folder, name, FPS)
        record(recorder, map(noise, range(60)))
        shutil.copytree(folder, tmp_path / "left")
        recorder.close()
    (camera,) = open_recording(tmp_path / "left").cameras
    # 32 KiB and the last frame are lost: these frames of noise take 20 KiB and more.
    assert 55 <= camera.video.num_frames < 60
    assert len([*read_frames(camera.video)]) == camera.times.num_frames


def test_a_recording_that_does_not_fit_keeps_what_fits(tmp_path, caplog):
    """A limit on the size of files stands for a full disk, of which FFmpeg says nothing."""
    recorder = CameraRecorder(tmp_path, "cam1", FPS)
    with files_up_to(500_000):
        record(recorder, map(noise, range(30)))
        counts = recorder.close()
    assert counts.frames + counts.left_out == 30
    # Frames of noise take 25 to 90 kB.
    assert 3 < counts.frames < 20
    assert len(list(read_frames(probe(recorder.video)))) == counts.frames
    expected = f"expected 30 frames, found {counts.frames}; is the disk full, or too slow?"
    assert caplog.messages == [f"{recorder.video}: {expected}"]


def test_a_disk_that_is_nearly_full_ends_the_recording_in_time(tmp_path, caplog):
    recorder = CameraRecorder(tmp_path, "cam1", FPS, least_free_bytes=10**18)
    for index in range(20):
        recorder.write(noise(index), index / FPS)
    assert vars(recorder.close()) == {"frames": 0, "left_out": 20}
    (said,) = [line for line in caplog.messages if "too slow" not in line]
    assert "less than 1000000000000 MB of free disk space; what was recorded before stays" in said


def test_the_folder_of_a_recording_keeps_other_files(laboratory, tmp_path):
    folder = tmp_path / "flight"
    # Of cameras that never film nothing stays, so that the second session is not refused.
    for _ in range(2):
        with recording_folder(folder, laboratory, RIG.names):
            assert (folder / "recording.toml").exists()
    assert not list(folder.iterdir())
    (folder / "notes.txt").write_text("mine")
    (folder / f"{RIG.names[0]}.avi").write_bytes(b"an earlier video")
    with recording_folder(folder, laboratory, RIG.names, force=True):
        assert not (folder / f"{RIG.names[0]}.avi").exists()
    assert (folder / "notes.txt").read_text() == "mine"


#: Folder -> words of the line; "odd" gets images of an odd width.
BAD_FOLDERS = {
    "laboratory": "--record: expected another folder",
    "odd": "even numbers of pixels",
    "file": "expected a folder that can be written, found file exists",
}


@pytest.mark.parametrize("folder", BAD_FOLDERS)
def test_a_folder_that_cannot_hold_a_recording(folder, laboratory, tmp_path):
    (tmp_path / "file").write_text("")
    recording = laboratory.with_rig(ring_rig(3, image_size_wh=(321 if folder == "odd" else 320, 240)))
    block = recording_folder(tmp_path / folder, recording, RIG.names, force=True)
    assert_refused(block.__enter__, BAD_FOLDERS[folder], unchanged=tmp_path)
