"""`psotrack live`: replayed files give the tracks of `track --causal`; cameras, devices, clients and disks fail.

What goes wrong while it runs is one line, and the others go on.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import stat
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import listening_at
from network_cameras import (
    CAMERAS,
    EFFORT,
    NUM_FRAMES,
    Cameras,
    film,
    film_on_the_network,
    free_port,
    laboratory_of,
    live_sequence,
    psotrack,
    python,
    wait_for_server,
)

from psotrack.errors import InputError
from psotrack.live import CameraStream, LiveSession, ReplayedVideo, UdpLines, live_cameras
from psotrack.recordings import read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import Trajectories, read_trajectories

pytestmark = pytest.mark.slow

SIZE_WH = (64, 48)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return live_sequence(tmp_path_factory)


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.getbasetemp() / "live_cache"


@pytest.fixture
def cameras() -> Iterator[Cameras]:
    with film_on_the_network() as processes:
        yield processes


@pytest.fixture
def small_video(tmp_path: Path) -> Path:
    """A video whose images are smaller than those of the rig."""
    path = tmp_path / "small.avi"
    writer = cv2.VideoWriter(f"{path}", cv2.VideoWriter.fourcc(*"XVID"), 10, SIZE_WH)
    for level in range(30):
        writer.write(np.full((*SIZE_WH[::-1], 3), level, np.uint8))
    writer.release()
    return path


def test_a_replay_without_losses_gives_the_tracks_of_the_offline_twin(
    sequence: Path, cache: Path, tmp_path: Path
) -> None:
    # Two of the cameras have rolling shutters: a frame has the time of its middle row, 3.8 ms after its first row.
    videos = {name: f"{sequence / name}i_s.avi" for name in CAMERAS}
    recording = laboratory_of(tmp_path, sequence, videos)
    text = recording.read_text().replace("fps = 10", "line_time_s = 2e-5", 2).replace("fps = 10\n", "")
    recording.write_text(text)
    common = ["--cameras", ",".join(CAMERAS), "--cache", cache, *EFFORT]
    offline = psotrack("track", recording, "--causal", "--out", tmp_path / "offline.csv", *common)
    assert offline.returncode == 0, offline.stderr
    # Slow enough for a machine that is busy with other tests.
    live = psotrack("live", recording, "--replay", "--speed", "0.2", "--out", tmp_path / "live.csv", *common)
    assert live.returncode == 0, live.stderr
    record = json.loads((tmp_path / "live.json").read_text())
    assert record["frames"] == NUM_FRAMES
    assert record["frames_left_out"] == 0
    assert record["late_searches"] is None
    assert not any(camera["left_out"] for camera in record["camera_frames"].values())
    assert (tmp_path / "live.csv").read_bytes() == (tmp_path / "offline.csv").read_bytes()
    twin = json.loads((tmp_path / "offline.json").read_text())
    for key in (
        "sequence",
        "causal",
        "cameras",
        "rate_hz",
        "settings",
        "seed",
        "volume",
        "drones",
        "versions",
    ):
        assert record[key] == twin[key], key
    # 3.6 seconds of video at a fifth of their rate: at least 17.8 s, when the last frame comes.
    assert 0 < record["real_time_factor"] < record["real_time_factor_running"] <= 0.203
    tracks = read_trajectories(tmp_path / "live.csv")
    assert tracks.num_drones >= 3
    # No row depends on a later frame: a shorter recording gives the beginning of the same table.
    short = psotrack("track", recording, "--causal", "--frames", 70, "--out", tmp_path / "short.csv", *common)
    assert short.returncode == 0, short.stderr
    assert (tmp_path / "live.csv").read_text().startswith((tmp_path / "short.csv").read_text())


def _take_datagrams(receiver: socket.socket, taken: list[str]) -> None:
    """Take datagrams, until one says that it is the end."""
    while (text := receiver.recv(65536).decode()) != "end":
        taken.append(text)


def test_rows_come_as_lines_by_udp_and_by_websocket(sequence: Path, cache: Path, tmp_path: Path) -> None:
    client = pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")
    port, sent, lines = free_port(), list[str](), tmp_path / "lines.txt"
    # A pipe that nobody reads takes 64 KiB, and then stops the program.
    with lines.open("w") as out, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        # Taken as they come: the system keeps only some hundred of them.
        taking = threading.Thread(target=_take_datagrams, args=(receiver, sent), daemon=True)
        taking.start()
        live = subprocess.Popen(
            [
                *(sys.executable, "-m", "psotrack", "live", f"{sequence}", "--replay", "--speed", "0.2"),
                *("--websocket", f"{port}", "--udp", f"127.0.0.1:{receiver.getsockname()[1]}", "--lines"),
                *("--json", f"{tmp_path / 'live.json'}"),
                *("--cameras", ",".join(CAMERAS), "--cache", f"{cache}", *EFFORT),
            ],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
        wait_for_server(port, live)
        assert listening_at(live.pid) == {"127.0.0.1"}
        # The server listens before anything is compiled, so a client that comes then gets all rows.
        with client.connect(f"ws://127.0.0.1:{port}") as connection:
            received = list(connection)
        _, err = live.communicate(timeout=60)
        receiver.sendto(b"end", receiver.getsockname())
        taking.join()
    assert live.returncode == 0, err
    assert f"rows are sent to clients of ws://127.0.0.1:{port}\n" in err
    assert json.loads((tmp_path / "live.json").read_text())["websocket"] == {"clients": 1}
    assert received == sent == lines.read_text().splitlines()
    rows = [json.loads(line) for line in received]
    assert set(rows[0]) == {
        *("frame", "time_s", "drone", "position_m", "velocity_m_s", "covariance_m2", "status")
    }
    assert np.shape(rows[0]["covariance_m2"]) == (3, 3)
    assert [row["frame"] for row in rows] == sorted(row["frame"] for row in rows)
    assert rows[-1]["status"] == "tracked"


def test_a_session_that_is_recorded_is_tracked_again(sequence: Path, cache: Path, tmp_path: Path) -> None:
    common = ["--cameras", ",".join(CAMERAS), "--cache", cache, *EFFORT]
    live = psotrack(
        "live", sequence, "--replay", "--speed", "0.2", "--out", tmp_path / "live.csv",
        "--record", tmp_path / "kept", *common,
    )  # fmt: skip
    assert live.returncode == 0, live.stderr
    recorded = json.loads((tmp_path / "live.json").read_text())["recorded"]
    kept = open_recording(tmp_path / "kept" / "recording.toml")
    source = open_recording(sequence)
    for name in CAMERAS:
        counts = recorded[name]
        assert counts["frames"] + counts["left_out"] == NUM_FRAMES
        assert kept.videos[name].num_frames == counts["frames"]
        # A busy machine leaves frames out; the others have the times at which they were filmed.
        assert counts["frames"] >= 0.8 * NUM_FRAMES
        assert set(kept.by_name[name].times.time_s) <= set(source.by_name[name].times.time_s)
    again = psotrack("track", tmp_path / "kept", "--out", tmp_path / "again.csv", "--cache", cache, *EFFORT)
    assert again.returncode == 0, again.stderr
    distance_m = _distances_m(
        read_trajectories(tmp_path / "live.csv"), read_trajectories(tmp_path / "again.csv")
    )
    # The codec and the background, which `track` learns from the whole video, move positions by 4 mm in the median, and
    # by 29 mm at most where nothing was left out: far less than the width of a drone, 0.3 m.
    assert len(distance_m) > 100
    assert np.median(distance_m) < 0.02
    assert np.mean(distance_m < 0.1) > 0.95


def _distances_m(tracks: Trajectories, others: Trajectories) -> np.ndarray:
    """Distance of each position to the nearest one of other tracks at the same time; labels may differ."""
    found = []
    for time_s, position_m in zip(tracks.time_s, tracks.position_m, strict=True):
        nearest = int(np.argmin(np.abs(others.time_s - time_s)))
        # Half the time from frame to frame.
        assert abs(others.time_s[nearest] - time_s) < 0.02
        between_m = np.linalg.norm(position_m[:, None] - others.position_m[nearest], axis=-1)
        found += [np.nanmin(row) for row in between_m if not np.isnan(row).all()]
    return np.array(found)


def test_cameras_on_the_network_stop_and_come_back(
    sequence: Path, cache: Path, tmp_path: Path, cameras: Cameras
) -> None:
    ports = {name: free_port() for name in CAMERAS}
    for name, port in ports.items():
        film(cameras, sequence / f"{name}i_s.avi", port)
    laboratory = laboratory_of(
        tmp_path, sequence, {name: f"http://127.0.0.1:{port}/" for name, port in ports.items()}
    )
    options = ["--out", f"{tmp_path / 'live.csv'}", "--cache", f"{cache}", "--most-drones", "4", *EFFORT]
    live = subprocess.Popen(
        [sys.executable, "-m", "psotrack", "live", f"{laboratory}", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    table = tmp_path / "live.csv"

    def wait_for_rows(count: int) -> None:
        before = table.read_text().count("\n") if table.exists() else 0
        for _ in range(1200):
            if table.exists() and table.read_text().count("\n") >= before + count:
                return
            assert live.poll() is None, live.communicate()
            time.sleep(0.1)
        raise AssertionError("no rows come")

    wait_for_rows(60)
    gone = ports["cam3"]
    cameras[gone].kill()
    cameras[gone].wait()
    wait_for_rows(60)
    film(cameras, sequence / "cam3i_s.avi", gone)
    wait_for_rows(60)
    live.send_signal(signal.SIGINT)
    out, err = live.communicate(timeout=60)
    assert live.returncode == 0, err
    assert "4 drones" in out or "3 drones" in out
    record = json.loads((tmp_path / "live.json").read_text())
    assert record["camera_frames"]["cam3"]["stops"] >= 1
    assert record["camera_frames"]["cam3"]["frames"] > 0
    assert "camera cam3: " in err
    assert "has broken off" in err
    # Said once, not once per frame.
    assert len(err.splitlines()) < 20
    # Three times 60 lines, of four drones at most.
    assert read_trajectories(table).num_frames >= 3 * 60 // 4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--replay"], "--out: expected --out FILE, --lines, --udp, --websocket or --view"),
        (["--lines"], "expected at least two cameras of the rig with the address of a stream"),
        (["--replay", "--out", "tracks.txt"], "ends in .csv"),
        (["--replay", "--udp", "nowhere"], "--udp: expected HOST:PORT"),
        (["--replay", "--websocket", "nowhere"], "--websocket: expected PORT or HOST:PORT"),
    ],
)
def test_what_cannot_be_done_is_one_line(sequence: Path, cache: Path, options: list[str], words: str) -> None:
    done = psotrack("live", sequence, "--cache", cache, *options)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


# --- What goes wrong


def first_line(address: str) -> str:
    """What a source says first."""
    with_frames = CameraStream(address, SIZE_WH).frames(time.monotonic, lambda: False)
    line = next(with_frames)
    with_frames.close()
    assert isinstance(line, str)
    return line


def test_each_reason_why_a_stream_is_silent_is_said(small_video: Path, cameras: Cameras) -> None:
    again = "it is tried again every second"
    silent = free_port()
    address = f"http://me:secret@127.0.0.1:{silent}/1"
    assert first_line(address) == (
        f"expected frames of http://me:***@127.0.0.1:{silent}/1, "
        f"found that it does not answer: connection refused; {again}"
    )
    # A host that accepts, and says nothing.
    with socket.create_server(("127.0.0.1", 0)) as dumb:
        address = f"rtsp://127.0.0.1:{dumb.getsockname()[1]}/1"
        expected = f"expected frames of {address}, found that it does not answer within 5 s; {again}"
        assert first_line(address) == expected
    port = free_port()
    film(cameras, small_video, port)
    address = f"http://127.0.0.1:{port}/nothing"
    expected = f"expected frames of {address}, found no video there; are path, user name and password right?"
    assert first_line(address) == f"{expected}; {again}"


def test_each_reason_why_a_device_is_silent_is_said(tmp_path: Path) -> None:
    again = "it is tried again every second"
    expected = "expected frames of device 63, found no /dev/video63; is the camera plugged in?"
    assert first_line("device 63") == f"{expected}; {again}"
    file = tmp_path / "video0"
    file.touch()
    expected = f"expected frames of device {file}, found no such camera, or another program that uses it"
    assert first_line(f"device {file}") == f"{expected}; {again}"


def test_a_device_without_permission(tmp_path: Path) -> None:
    file = tmp_path / "video0"
    file.touch(mode=0)
    # The worker's folder, the run's and the user's, which pytest opens to this user alone.
    for folder in (tmp_path, *tmp_path.parents[:3]):
        if not folder.stat().st_mode & stat.S_IXOTH:
            folder.chmod(folder.stat().st_mode | stat.S_IXOTH)
    # Root may open every file: a process of root becomes another user, when everything is imported.
    script = """
        import os, sys, time
        from psotrack.live import CameraStream
        frames = CameraStream(sys.argv[1], (64, 48)).frames(time.monotonic, lambda: False)
        if os.getuid() == 0:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
        print(next(frames))
    """
    command = [sys.executable, "-B", "-c", textwrap.dedent(script), f"device {file}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == (
        f"expected frames of device {file}, found no permission for {file}; is this user in the group that owns it, "
        "mostly `video`?; it is tried again every second"
    ), done.stderr


@pytest.mark.skipif(
    cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), reason="this OpenCV has GStreamer, as few builds have"
)
def test_a_pipeline_without_gstreamer() -> None:
    with pytest.raises(InputError, match="expected a build of OpenCV with GStreamer, found OpenCV without"):
        first_line("gstreamer://videotestsrc ! appsink")


def test_the_other_cameras_go_on(
    sequence: Path, cache: Path, tmp_path: Path, small_video: Path, cameras: Cameras
) -> None:
    """A device that is not there, and a camera that sends another size, beside two that film."""
    ports = [free_port() for _ in range(3)]
    for port, video in zip(ports, ("cam1i_s.avi", "cam3i_s.avi", small_video), strict=True):
        film(cameras, sequence / video, port)
    videos = [f"http://127.0.0.1:{ports[0]}/", f"http://127.0.0.1:{ports[1]}/", 63]
    laboratory = laboratory_of(
        tmp_path,
        sequence,
        dict(zip(CAMERAS, [*videos, f"http://me:secret@127.0.0.1:{ports[2]}/"], strict=True)),
    )
    options = ["--cache", cache, "--seconds", "5", "--record", tmp_path / "kept", *EFFORT]
    done = psotrack("live", laboratory, "--out", tmp_path / "live.csv", *options)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    missing = "camera cam5: expected frames of device 63, found no /dev/video63; is the camera plugged in?"
    assert lines.count(f"psotrack: warning: {missing}; it is tried again every second") == 1
    size = (
        "expected images of 672 x 378 pixels, as the rig says, found 64 x 48; let the camera send this size"
    )
    assert sum(f"camera cam7: http://me:***@127.0.0.1:{ports[2]}/: {size}" in line for line in lines) == 1
    assert "secret" not in done.stderr
    assert "Traceback" not in done.stderr
    record = json.loads((tmp_path / "live.json").read_text())
    assert record["frames"] > 10
    assert open_recording(tmp_path / "kept").rig.names == CAMERAS[:2]
    unknown = psotrack("live", laboratory, "--lines", "--cameras", "cam1,cam9", "--cache", cache)
    assert unknown.returncode == 2
    assert unknown.stderr.startswith("psotrack: cameras: expected some of cam1, cam3, cam5, cam7, found cam9")


def test_without_two_cameras_that_film_the_command_ends(
    sequence: Path, cache: Path, tmp_path: Path, cameras: Cameras
) -> None:
    port, silent = free_port(), free_port()
    film(cameras, sequence / "cam1i_s.avi", port)
    address = f"http://127.0.0.1:{silent}/"
    videos = {"cam1": f"http://127.0.0.1:{port}/", "cam3": address, "cam5": 63}
    laboratory = laboratory_of(tmp_path, sequence, videos)
    done = psotrack(
        "live", laboratory, "--out", tmp_path / "live.csv", "--record", tmp_path / "kept", "--cache", cache, *EFFORT
    )  # fmt: skip
    assert done.returncode == 2
    *lines, last = done.stderr.splitlines()
    assert last == (
        "psotrack: the cameras: expected at least two cameras that film, found 1 of 3; the lines above say why"
    )
    assert sorted(line.split(", found")[0] for line in lines if "expected" in line) == [
        f"psotrack: warning: camera cam3: expected frames of {address}",
        "psotrack: warning: camera cam5: expected frames of device 63",
    ]
    # Nothing is in the way of the next attempt, but what cam1 has filmed is kept.
    assert not list(tmp_path.glob("live*"))


class TestFullDisk:
    """A full disk: no space, as /dev/full has none, or a limit on the size of files."""

    @pytest.fixture
    def command(self, sequence: Path, cache: Path) -> list[object]:
        return ["live", sequence, "--replay", "--cameras", ",".join(CAMERAS), "--cache", cache, *EFFORT]

    @pytest.fixture
    def full_table(self, tmp_path: Path) -> Path:
        if not os.path.exists("/dev/full"):
            pytest.skip("needs /dev/full")
        (tmp_path / "live.csv").symlink_to("/dev/full")
        return tmp_path / "live.csv"

    def test_other_outputs_go_on(self, command: list[object], full_table: Path) -> None:
        done = psotrack(*command, "--out", full_table, "--force", "--lines", "--speed", "0.3")
        assert done.returncode == 2
        line = f"{full_table}: expected to write rows, found no space left on device"
        assert f"psotrack: warning: {line}; tracking goes on with the other outputs" in done.stderr
        assert done.stderr.splitlines()[-1] == f"psotrack: {line}"
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        # To the end of the video: a busy machine leaves out a few of its frames.
        assert max(row["frame"] for row in rows) >= NUM_FRAMES - 10

    def test_lines_to_a_full_disk(self, command: list[object], full_table: Path) -> None:
        with full_table.open("w") as full:
            done = psotrack(*command, "--lines", "--speed", "0.3", stdout=full)
        assert done.returncode == 2
        assert (
            done.stderr.splitlines()[-1]
            == "psotrack: --lines: expected to write rows, found no space left on device"
        )
        assert "Exception ignored" not in done.stderr

    def test_a_recording_that_does_not_fit_keeps_what_fits(
        self, command: list[object], tmp_path: Path
    ) -> None:
        """Tracking goes on to the end, and the record says how many frames are on the disk."""
        options = [*command, "--speed", "0.3"]
        assert psotrack(*options, "--seconds", "2", "--lines").returncode == 0  # compiled programs are stored
        limited = (
            "import resource; "
            "resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000)); "
            "from psotrack.cli import main; main()"
        )
        done = python(
            "-c", limited, *options, "--out", tmp_path / "live.csv", "--record", tmp_path / "kept",
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        record = json.loads((tmp_path / "live.json").read_text())
        assert record["frames"] >= NUM_FRAMES - 10
        assert read_trajectories(tmp_path / "live.csv").frame.max() >= NUM_FRAMES - 10
        kept = open_recording(tmp_path / "kept")
        for name in CAMERAS:
            counts = record["recorded"][name]
            assert counts["frames"] + counts["left_out"] == NUM_FRAMES
            assert 10 < counts["frames"] < NUM_FRAMES - 10
            assert len(list(read_frames(kept.videos[name]))) == counts["frames"]
            assert f"{name}.avi: expected " in done.stderr


def test_an_unreachable_network_stops_nothing(caplog: pytest.LogCaptureFixture) -> None:
    frame = Trajectories(
        np.array([0]), np.array([0.0]), ("1",), np.zeros((1, 1, 3)), velocity_m_s=np.zeros((1, 1, 3)),
        covariance_m2=np.zeros((1, 1, 3, 3)), status=np.zeros((1, 1), int),
    )  # fmt: skip
    # The system refuses to send to all hosts unless a program asks for it.
    with (
        caplog.at_level(logging.WARNING, "psotrack"),
        contextlib.closing(UdpLines("255.255.255.255:9")) as udp,
    ):
        for _ in range(3):
            udp.write(frame)
    # Once, not at every instant.
    found = "expected to send rows, found permission denied; tracking goes on"
    assert caplog.messages == [f"--udp 255.255.255.255:9: {found}"]


def test_a_video_that_is_gone_when_the_session_begins(
    sequence: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = open_recording(sequence)
    cameras = live_cameras(recording, CAMERAS, replay=True)
    gone = cameras[0]
    assert isinstance(gone.source, ReplayedVideo)
    video = replace(gone.source.video, path=tmp_path / "gone.avi")
    cameras[0] = replace(gone, source=replace(gone.source, video=video))
    settings = TrackSettings().changed({"swarm.particles": 20, "swarm.iterations": 15})
    session = LiveSession(recording, cameras, settings, most_drones=4)
    result = session.run([], longest_s=1.0)
    assert result.instants > 0
    assert result.cameras[gone.name].counts.frames == 0
    assert [
        line for line in caplog.messages if line.startswith(f"camera {gone.name}: ") and "gone.avi" in line
    ]


def test_a_signal_that_comes_while_another_one_stops_the_session(sequence: Path) -> None:
    """A signal handler that interrupted itself waited for ever."""
    script = """
        import os, signal, sys, threading, time
        from psotrack.recordings.datasets import open_recording
        from psotrack.live import LiveSession, live_cameras
        from psotrack.settings import TrackSettings

        recording = open_recording(sys.argv[1])
        session = LiveSession(recording, live_cameras(recording, replay=True), TrackSettings())
        signal.signal(signal.SIGINT, lambda *_: session.stop())
        ends_s = time.monotonic() + 2

        def send():
            while time.monotonic() < ends_s:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1e-4)  # so that not more handlers interrupt each other than Python allows

        threading.Thread(target=send, daemon=True).start()
        while time.monotonic() < ends_s:
            session.stop()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        print("ended")
    """
    command = [sys.executable, "-c", textwrap.dedent(script), f"{sequence}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=40, check=False)
    assert done.stdout == "ended\n", done.stderr
