"""`psotrack live`: replayed files give the tracks of `track --causal`; cameras, devices, clients and disks fail.

What goes wrong while it runs is one line, and the others go on.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import worlds
from helpers import assert_refused, listening_at
from network_cameras import (
    CAMERAS,
    EFFORT,
    NUM_FRAMES,
    NetworkCamera,
    film,
    free_port,
    jpeg_part,
    laboratory_of,
    live_sequence,
    rows_of,
    wait_for_lines,
    wait_until,
)

from psotrack.errors import InputError
from psotrack.live import CameraStream, LiveSession, UdpLines, live_cameras
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import read_trajectories

AGAIN = "it is tried again every second"
#: Speed of replays.
SPEED = "0.2"


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return live_sequence(tmp_path_factory)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smaller flight, for what needs no drones that can be tracked."""
    return worlds.two_flights(tmp_path_factory) / "flight"


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.getbasetemp() / "live_cache"


@pytest.fixture
def cameras() -> Iterator[list[NetworkCamera]]:
    """Cameras that are stopped after the test."""
    made: list[NetworkCamera] = []
    yield made
    for camera in made:
        if not camera.has_ended:
            camera.stop()


@pytest.fixture
def meanwhile() -> Iterator[Callable[[Callable[[], object]], None]]:
    """Does something in a thread while the test runs, and raises its error at the end of the test."""
    done: list[Future] = []

    def end_the_session(future: Future) -> None:
        # The session in the main thread would wait for ever.
        if future.exception() is not None:
            os.kill(os.getpid(), signal.SIGINT)

    def start(work: Callable[[], object]) -> None:
        done.append(pool.submit(work))
        done[-1].add_done_callback(end_the_session)

    with ThreadPoolExecutor() as pool:
        yield start
    for future in done:
        future.result()


@contextlib.contextmanager
def datagrams() -> Iterator[tuple[str, list[str]]]:
    """The address of a receiver, and what has come to it when the block ends."""
    sent = list[str]()

    def take() -> None:
        # Taken as they come: the system keeps only some hundred of them.
        while (text := receiver.recv(65536).decode()) != "end":
            sent.append(text)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        taking = threading.Thread(target=take, daemon=True)
        taking.start()
        yield f"127.0.0.1:{receiver.getsockname()[1]}", sent
        receiver.sendto(b"end", receiver.getsockname())
        taking.join()


@pytest.mark.slow
def test_a_replay_gives_the_tracks_of_its_offline_twin_to_all_outputs(
    sequence: Path, cache: Path, tmp_path: Path, run_psotrack, meanwhile
) -> None:
    client = pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")
    # Two of the cameras have rolling shutters: a frame has the time of its middle row, 2.7 ms after its first row.
    lines = {name: "line_time_s = 2e-5" if name in CAMERAS[:2] else "" for name in CAMERAS}
    keys = {name: f'video = "{sequence / name}i_s.avi"\n{line}' for name, line in lines.items()}
    recording = laboratory_of(tmp_path, sequence, keys)
    common = ["--cache", cache, *EFFORT]
    port, received = free_port(), list[str]()

    def answers() -> bool:
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", port)) == 0

    def listen() -> None:
        wait_until(answers, f"nobody answers at port {port}")
        assert listening_at(os.getpid()) == {"127.0.0.1"}
        with client.connect(f"ws://127.0.0.1:{port}") as connection:
            received.extend(connection)

    meanwhile(listen)
    with datagrams() as (address, sent):
        # Slow enough for a machine that is busy with other tests.
        live = run_psotrack(
            *("live", recording, "--replay", "--speed", SPEED, "--out", tmp_path / "live.csv", "--lines"),
            *("--udp", address, "--websocket", port, "--record", tmp_path / "kept", *common),
        )
    assert live.code == 0, live.err
    assert f"rows are sent to clients of ws://127.0.0.1:{port}\n" in live.err
    assert sent == live.out.splitlines()
    # The client may come after the first rows.
    assert received == sent[-len(received) :]
    rows = [json.loads(line) for line in sent]
    columns = ("frame", "time_s", "drone", "position_m", "velocity_m_s", "covariance_m2", "status")
    assert set(rows[0]) == set(columns)
    assert np.shape(rows[0]["covariance_m2"]) == (3, 3)
    assert [row["frame"] for row in rows] == sorted(row["frame"] for row in rows)
    assert rows[-1]["status"] == "tracked"
    assert {row["drone"] for row in rows} >= {"0", "1", "2"}

    record = json.loads((tmp_path / "live.json").read_text())
    assert record["websocket"] == {"clients": 1}
    assert (record["frames"], record["frames_left_out"], record["late_searches"]) == (NUM_FRAMES, 0, None)
    assert not any(camera["left_out"] for camera in record["camera_frames"].values())
    # The last frame comes when all others are over.
    fastest = float(SPEED) * NUM_FRAMES / (NUM_FRAMES - 1)
    assert 0 < record["real_time_factor"] < record["real_time_factor_running"] <= fastest
    offline = run_psotrack("track", recording, "--causal", "--out", tmp_path / "off.csv", *common)
    assert offline.code == 0, offline.err
    assert (tmp_path / "live.csv").read_bytes() == (tmp_path / "off.csv").read_bytes()
    twin = json.loads((tmp_path / "off.json").read_text())
    same = ("sequence", "causal", "cameras", "rate_hz", "settings", "seed", "volume", "drones", "versions")
    assert {key: record[key] for key in same} == {key: twin[key] for key in same}

    kept, source = open_recording(tmp_path / "kept" / "recording.toml"), open_recording(recording)
    for name in CAMERAS:
        counts = record["recorded"][name]
        assert counts["frames"] + counts["left_out"] == NUM_FRAMES
        assert kept.videos[name].num_frames == counts["frames"]
        # A busy machine leaves frames out; the others have the times at which they were filmed.
        assert counts["frames"] >= 0.8 * NUM_FRAMES
        assert set(kept.by_name[name].times.time_s) <= set(source.by_name[name].times.time_s)


def filmed_by(videos: list[str]) -> dict[str, str]:
    """TOML keys of the cameras with these videos."""
    return {name: f"video = {video}\nfps = 10" for name, video in zip(CAMERAS, videos, strict=True)}


@pytest.mark.slow
def test_cameras_stop_come_back_are_missing_or_send_another_size(
    sequence: Path, cache: Path, tmp_path: Path, cameras: list[NetworkCamera], run_psotrack, meanwhile, caplog
) -> None:
    """One camera breaks off and comes back, a device is not there, and a camera sends another size."""
    cameras += [film(sequence / "cam1i_s.avi"), film(sequence / "cam2i_s.avi")]
    cameras.append(NetworkCamera(lambda: iter([jpeg_part(np.zeros((48, 64, 3), np.uint8))] * 9)))
    wrong = cameras[2].address.replace("http://", "http://me:secret@")
    videos = [f'"{cameras[0].address}"', f'"{cameras[1].address}"', "63", f'"{wrong}"']
    laboratory, table = laboratory_of(tmp_path, sequence, filmed_by(videos)), tmp_path / "live.csv"

    def stop_and_film() -> None:
        wait_for_lines(table, 20)
        gone = cameras[1]
        gone.stop()
        wait_until(lambda: any("has broken off" in line for line in caplog.messages), "nobody says it")
        wait_for_lines(table, table.read_text().count("\n") + 20)
        cameras.append(film(sequence / "cam2i_s.avi", gone.server_address[1]))
        wait_until(lambda: "camera cam2 films again" in caplog.messages, "the camera does not come back")
        wait_for_lines(table, table.read_text().count("\n") + 20)
        os.kill(os.getpid(), signal.SIGINT)

    meanwhile(stop_and_film)
    done = run_psotrack(
        *("live", laboratory, "--out", table, "--record", tmp_path / "kept", "--cache", cache, *EFFORT)
    )
    assert done.code == 0, done.err
    record = json.loads((tmp_path / "live.json").read_text())
    assert record["camera_frames"]["cam2"]["stops"] >= 1
    assert record["camera_frames"]["cam2"]["frames"] > 0
    missing = "camera cam3: expected frames of device 63, found no /dev/video63; is the camera plugged in?"
    hidden = cameras[2].address.replace("http://", "http://me:***@")
    size = f"camera cam4: {hidden}: expected images of 480 x 270 pixels, as the rig says, found 64 x 48; let"
    # Said once, not once per frame.
    for said in (f"{missing}; {AGAIN}", size):
        assert sum(line.startswith(said) for line in caplog.messages) == 1
    assert not any("secret" in line for line in (*caplog.messages, done.err))
    assert len(caplog.messages) < 20
    assert read_trajectories(table).num_frames >= 60 // 4
    assert open_recording(tmp_path / "kept").rig.names == CAMERAS[:2]


@pytest.mark.slow
def test_without_two_cameras_that_film_the_command_ends(
    sequence: Path, cache: Path, tmp_path: Path, cameras: list[NetworkCamera], run_psotrack, caplog
) -> None:
    cameras.append(film(sequence / "cam1i_s.avi"))
    silent = f"http://127.0.0.1:{free_port()}/"
    videos = filmed_by([f'"{cameras[0].address}"', f'"{silent}"', "63", "63"])
    laboratory = laboratory_of(tmp_path, sequence, videos)
    done = run_psotrack(
        *("live", laboratory, "--out", tmp_path / "live.csv", "--record", tmp_path / "kept"),
        *("--cache", cache, *EFFORT),
    )
    assert done.code == 2
    last = "expected at least two cameras that film, found 1 of 4; the lines above say why"
    assert done.err == f"psotrack: the cameras: {last}\n"
    assert sorted(line.split(", found")[0] for line in caplog.messages if "expected" in line) == [
        f"camera cam2: expected frames of {silent}",
        "camera cam3: expected frames of device 63",
        "camera cam4: expected frames of device 63",
    ]
    # Nothing is in the way of the next attempt, but what cam1 has filmed is kept.
    assert not list(tmp_path.glob("live*"))


#: Name of the case -> options, and words of the line.
BAD = {
    "no output": (["--replay"], "--out: expected --out FILE, --lines, --udp, --websocket or --view"),
    "files": (["--lines"], "the number of a device as `video`, found none; --replay plays the videos"),
    "another kind of file": (["--replay", "--out", "tracks.txt"], "ends in .csv"),
    "no address": (["--replay", "--udp", "nowhere"], "--udp: expected HOST:PORT"),
    "no port": (["--replay", "--websocket", "nowhere"], "--websocket: expected PORT or HOST:PORT"),
    "no such camera": (
        ["--lines", "--replay", "--cameras", "c1,c9"],
        "cameras: expected some of c0, c1, c2, found c9",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_done_is_one_line(
    name: str, flight: Path, tmp_path: Path, monkeypatch, run_psotrack
) -> None:
    options, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PSOTRACK_CACHE", str(flight.parent / "cache"))
    assert_refused(lambda: run_psotrack("live", flight, *options), words, unchanged=tmp_path)


# --- What goes wrong


def first_line(address: str) -> str:
    """What a source says first."""
    with contextlib.closing(CameraStream(address, (64, 48)).frames(time.monotonic, lambda: False)) as source:
        return next(source)


def test_each_reason_why_a_stream_is_silent_is_said(cameras: list[NetworkCamera], monkeypatch) -> None:
    monkeypatch.setattr("psotrack.live.sources._AGAIN_S", 0.0)
    monkeypatch.setattr("psotrack.live.sources.ANSWER_S", 0.5)
    silent = free_port()
    assert first_line(f"http://me:secret@127.0.0.1:{silent}/1") == (
        f"expected frames of http://me:***@127.0.0.1:{silent}/1, "
        f"found that it does not answer: connection refused; {AGAIN}"
    )
    # A host that accepts, and says nothing.
    with socket.create_server(("127.0.0.1", 0)) as dumb:
        address = f"rtsp://127.0.0.1:{dumb.getsockname()[1]}/1"
        expected = f"expected frames of {address}, found that it does not answer within 0.5 s; {AGAIN}"
        assert first_line(address) == expected
    cameras.append(NetworkCamera(lambda: []))
    address = f"{cameras[0].address}nothing"
    expected = f"expected frames of {address}, found no video there; are path, user name and password right?"
    assert first_line(address) == f"{expected}; {AGAIN}"


def test_each_reason_why_a_device_is_silent_is_said(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("psotrack.live.sources._AGAIN_S", 0.0)
    expected = "expected frames of device 63, found no /dev/video63; is the camera plugged in?"
    assert first_line("device 63") == f"{expected}; {AGAIN}"
    file = tmp_path / "video0"
    file.touch()
    expected = f"expected frames of device {file}, found no such camera, or another program that uses it"
    assert first_line(f"device {file}") == f"{expected}; {AGAIN}"
    if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
        with pytest.raises(
            InputError, match="expected a build of OpenCV with GStreamer, found OpenCV without"
        ):
            first_line("gstreamer://videotestsrc ! appsink")
    # Root may open every file.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    expected = (
        f"expected frames of device {file}, found no permission for {file}; is this user in the group that"
    )
    assert first_line(f"device {file}") == f"{expected} owns it, mostly `video`?; {AGAIN}"


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_other_outputs_go_on_where_disks_are_full(
    sequence: Path, cache: Path, tmp_path: Path, run_psotrack, monkeypatch, caplog
) -> None:
    """The table and the lines meet a full disk, so that the datagrams alone go on."""
    table = tmp_path / "live.csv"
    table.symlink_to("/dev/full")
    with datagrams() as (address, sent), open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        done = run_psotrack(
            *("live", sequence, "--replay", "--speed", SPEED, "--out", table, "--force", "--lines"),
            *("--udp", address, "--cache", cache, *EFFORT),
        )
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()
    assert done.code == 2
    no_space = "expected to write rows, found no space left on device"
    for output in (table, "--lines"):
        assert f"{output}: {no_space}; tracking goes on with the other outputs" in caplog.messages
    assert done.err == f"psotrack: {table}: {no_space}\n"
    # To the end of the video: a busy machine leaves out a few of its frames.
    assert max(json.loads(row)["frame"] for row in sent) >= NUM_FRAMES - 10


def test_an_unreachable_network_stops_nothing(caplog: pytest.LogCaptureFixture) -> None:
    # The system refuses to send to all hosts unless a program asks for it.
    with contextlib.closing(UdpLines("255.255.255.255:9")) as udp:
        for frame in range(3):
            udp.write(rows_of(frame))
    # Once, not at every instant.
    found = "expected to send rows, found permission denied; tracking goes on"
    assert caplog.messages == [f"--udp 255.255.255.255:9: {found}"]


def test_a_signal_that_comes_while_another_one_stops_the_session(flight: Path) -> None:
    """A signal handler that interrupted itself waited for ever."""
    recording = open_recording(flight)
    session = LiveSession(recording, live_cameras(recording, replay=True), TrackSettings())
    before = signal.signal(signal.SIGINT, lambda *_: session.stop())
    is_over = threading.Event()

    def send() -> None:
        while not is_over.is_set():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1e-4)  # so that not more handlers interrupt each other than Python allows

    sender = threading.Thread(target=send, daemon=True)
    # If this waits for ever, the test run ends here, and says where.
    faulthandler.dump_traceback_later(60, exit=True)
    sender.start()
    for _ in range(500_000):
        session.stop()
    is_over.set()
    sender.join()
    faulthandler.cancel_dump_traceback_later()
    signal.signal(signal.SIGINT, before)
