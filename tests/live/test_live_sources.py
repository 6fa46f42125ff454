"""Frames of streams: none is lost that comes in time, and jitter of arrival does not move the time of filming."""

from __future__ import annotations

import http.server
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import cameras_of, ring_rig

from psotrack.live import CameraStream, SourceFrame, StreamClock, live_cameras
from psotrack.recordings import Recording

SIZE_WH = (64, 48)
FPS = 25.0


def test_cameras_have_the_short_names_of_other_commands() -> None:
    rig = ring_rig(3, image_size_wh=SIZE_WH)
    streams = {name: f"rtsp://camera/{name}" for name in rig.names}
    recording = Recording("laboratory", Path("laboratory"), cameras_of(rig, stream=streams))
    cameras = live_cameras(recording, ["0", "2"], replay=False)
    assert [camera.name for camera in cameras] == [rig.names[0], rig.names[2]]
    assert cameras[1].source == CameraStream(streams[rig.names[2]], SIZE_WH)


def clock_times(stream_s: np.ndarray, arrived_s: np.ndarray) -> tuple[np.ndarray, list[bool | None]]:
    clock, times_s, is_used = StreamClock(), [], []
    for of_stream_s, of_arrival_s in zip(stream_s.tolist(), arrived_s.tolist(), strict=True):
        times_s.append(clock.time_s(of_stream_s, of_arrival_s))
        is_used.append(clock.is_used)
    return np.array(times_s), is_used


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
def test_jitter_is_removed_from_the_times_of_a_stream(drift: float) -> None:
    rng = np.random.default_rng(0)
    filmed_s = 1000 + np.arange(1000) / FPS
    arrived_s = np.maximum.accumulate(filmed_s + 0.08 + rng.exponential(0.02, len(filmed_s)))
    times_s, is_used = clock_times((filmed_s - 1000) * (1 + drift), arrived_s)
    used = np.array([each is True for each in is_used])
    assert used[-1]
    assert used.mean() > 0.85
    error_s = (times_s - filmed_s - 0.08)[used]
    # The least lateness of 50 frames is 0.4 ms in the mean; and clocks that are 1e-4 apart move by 0.4 ms in 4 s.
    assert np.abs(error_s).max() < 0.004
    assert np.abs((arrived_s - filmed_s - 0.08)[used]).max() > 0.05


def test_times_that_are_no_times_of_this_clock_are_not_used() -> None:
    arrived_s = 1000 + np.arange(500) / FPS
    number = np.arange(500)
    for stream_s in (
        number * 0.0,  # none at all
        number / 30,  # of another rate, as FFmpeg invents them
        np.where(number % 3 == 2, number - 2, number) / FPS,  # that go back
    ):
        times_s, is_used = clock_times(stream_s, arrived_s)
        assert is_used[-1] is False
        np.testing.assert_array_equal(times_s, arrived_s)


def test_a_frame_that_the_stream_does_not_count_is_noticed() -> None:
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


class _Camera(http.server.ThreadingHTTPServer):
    """A camera that sends parts of a stream at given times after the first connection."""

    daemon_threads = True

    def __init__(self, kind: str, parts: list[bytes], at_s: np.ndarray) -> None:
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.end_headers()
                began_s = time.monotonic()
                try:
                    for part, part_s in zip(parts, at_s.tolist(), strict=True):
                        time.sleep(max(0.0, began_s + part_s - time.monotonic()))
                        self.wfile.write(part)
                except OSError:  # the client has gone
                    return

            def log_message(self, *arguments: object) -> None:
                pass

        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()


@pytest.fixture
def serve() -> Iterator[Callable[[str, list[bytes], np.ndarray], str]]:
    cameras = []

    def start(kind: str, parts: list[bytes], at_s: np.ndarray) -> str:
        cameras.append(_Camera(kind, parts, at_s))
        return f"http://127.0.0.1:{cameras[-1].server_address[1]}/"

    yield start
    for camera in cameras:
        camera.shutdown()
        camera.server_close()


def taken(
    address: str, seconds: float, work_s: float = 0.0
) -> tuple[list[SourceFrame], list[float], list[str]]:
    """The frames of a stream until it breaks off, their ages when they are taken, and what is said."""
    ends_s = time.monotonic() + seconds
    frames, ages_s, lines = [], [], []
    source = CameraStream(address, SIZE_WH).frames(lambda: 0.0, lambda: time.monotonic() > ends_s)
    for frame in source:
        if isinstance(frame, SourceFrame):
            frames.append(frame)
            ages_s.append(time.monotonic() - frame.arrived_s)
            time.sleep(work_s)
        else:
            lines.append(frame)
            if "broken off" in frame:
                break
    source.close()
    return frames, ages_s, lines


def jpeg_parts(count: int) -> list[bytes]:
    parts = []
    for number in range(count):
        image = cv2.imencode(".jpg", np.full((*SIZE_WH[::-1], 3), 2 * number, np.uint8))[1].tobytes()
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
        parts.append(head.encode() + image + b"\r\n")
    return parts


MJPEG = "multipart/x-mixed-replace; boundary=frame"


def test_frames_that_come_close_together_are_not_lost(serve: Callable[..., str]) -> None:
    """A frame that could be read at once was taken for one that had waited, and left out."""
    # Five frames together, five times per second: four of them are there when they are asked for.
    frames, _, _ = taken(serve(MJPEG, jpeg_parts(60), np.arange(60) // 5 / 5), 30)
    # The last image is complete only when the next one begins.
    assert len(frames) >= 59
    levels = [frame.image.mean() for frame in frames]
    assert np.abs(np.diff(levels) - 2).max() < 1.5


def test_frames_that_wait_for_a_slow_program_tell_their_age(serve: Callable[..., str]) -> None:
    """So that the session can leave them out: in the buffers of a stream, they looked as new as the last one."""
    frames, ages_s, _ = taken(serve(MJPEG, jpeg_parts(75), np.arange(75) / FPS), 30, work_s=0.08)
    assert len(frames) >= 74
    # The program takes twice as long as the camera.
    assert ages_s[-1] > 1.5
    # A busy machine may stop the reader for a while.
    arrived_s = np.array([frame.arrived_s for frame in frames])
    assert arrived_s[-1] - arrived_s[0] < 4.5


@pytest.mark.slow
def test_the_times_of_a_stream_are_used_and_said(
    serve: Callable[..., str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A Matroska stream has times; its packets come late by up to 30 ms."""
    path, count = tmp_path / "film.mkv", 300
    writer = cv2.VideoWriter(f"{path}", cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE_WH)
    assert writer.isOpened()
    rng = np.random.default_rng(0)
    for _ in range(count):
        writer.write(rng.integers(0, 255, (*SIZE_WH[::-1], 3), dtype=np.uint8))
    writer.release()
    coded = path.read_bytes()
    # Each part ends with the end of a JPEG image.
    first, *others, last = coded.split(b"\xff\xd9")
    parts = [first + b"\xff\xd9", *(each + b"\xff\xd9" for each in others), last]
    assert len(parts) == count + 1
    at_s = np.arange(count + 1) / FPS + rng.exponential(0.012, count + 1).clip(max=0.03)
    address = serve("video/x-matroska", parts, at_s)
    with caplog.at_level("INFO", "psotrack"):
        frames, _, lines = taken(address, 60)
    assert f"{address}: frames are timed by the stream" in caplog.messages
    assert not [line for line in lines if "when they arrive" in line]
    # Where a frame that is less late than all before comes, the times go back by the difference.
    times_s, arrived_s = (
        np.diff([getattr(frame, name) for frame in frames[-100:]]) for name in ("time_s", "arrived_s")
    )
    assert np.median(np.abs(times_s - 1 / FPS)) < 0.0006  # the stream's times are whole milliseconds
    assert np.median(np.abs(arrived_s - 1 / FPS)) > 0.004


@pytest.mark.slow
def test_a_stream_without_times_of_its_own_says_so_once(serve: Callable[..., str]) -> None:
    """FFmpeg invents 25 frames per second for images over HTTP."""
    frames, _, lines = taken(serve(MJPEG, jpeg_parts(100), np.arange(100) / 10), 30)
    assert len([line for line in lines if "frames are timed when they arrive" in line]) == 1
    assert all(frame.time_s == frame.arrived_s for frame in frames)
