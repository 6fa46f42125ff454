"""`psotrack live`: replayed files give the tracks of `track --causal`; cameras, devices, clients and disks fail.

Cameras on the network, their streams and the clients of WebSockets have real sockets. What goes wrong while it runs is
one line, and the others go on.
"""

import contextlib
import faulthandler
import http.server
import json
import multiprocessing
import os
import re
import signal
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from helpers import assert_refused, listening_at, made_once
from small_sweeps import wait_until

from psotrack.geometry.rig_files import write_rig
from psotrack.live import (
    CameraStream,
    LiveSession,
    SourceFrame,
    UdpLines,
    WebSocketLines,
    lines_of,
    live_cameras,
)
from psotrack.recordings import probe, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.trajectories import Status, Trajectories, read_trajectories

#: Few, small cameras: a machine that is busy with other tests must keep up with the replay.
CAMERAS = ("cam1", "cam2", "cam3", "cam4")
NUM_FRAMES, SCALE = 40, 0.25
#: A program is compiled for 1, 2 and 4 drones.
EFFORT = ["--particles", "20", "--iterations", "15", "--most-drones", "4"]
MJPEG = "multipart/x-mixed-replace; boundary=frame"
#: Size of small images of streams.
SMALL_WH = (64, 48)
AGAIN = "it is tried again every second"
#: Speed of replays.
SPEED = "0.2"


# --- cameras on the network


class NetworkCamera(http.server.ThreadingHTTPServer):
    """A camera that sends the parts of a stream to each connection, in a thread of this process.

    Args:
        parts: makes the parts of one connection's stream, and sleeps between them.
        kind: type of the stream's content.
        port: port of this computer; 0 for a free one.
    """

    daemon_threads = True

    def __init__(self, parts, kind=MJPEG, port=0):
        camera = self
        self.has_ended = False

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                if self.path == "/nothing":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.end_headers()
                try:
                    for part in parts():
                        if camera.has_ended:
                            return
                        self.wfile.write(part)
                except OSError:  # the client has gone
                    return

            def log_message(self, *arguments):
                pass

        super().__init__(("127.0.0.1", port), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def stop(self):
        """End all connections, and answer no others."""
        self.has_ended = True
        self.shutdown()
        self.server_close()


def jpeg_part(image):
    coded = cv2.imencode(".jpg", image)[1].tobytes()
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(coded)}\r\n\r\n"
    return head.encode() + coded + b"\r\n"


def timed(parts, at_s):
    """Parts that come at given times after a connection's beginning."""

    def stream():
        began_s = time.monotonic()
        for part, part_s in zip(parts, at_s.tolist(), strict=True):
            time.sleep(max(0.0, began_s + part_s - time.monotonic()))
            yield part

    return stream


def film(video, port=0):
    """A camera that sends the frames of a video again and again, 10 per second, as a busy machine must keep up."""
    parts = [jpeg_part(image) for image in read_frames(probe(video))]

    def stream():
        while True:
            # All cameras show the same moment, as cameras of one room do.
            yield parts[int(time.time() * 10) % len(parts)]
            time.sleep(0.1 - time.time() % 0.1)

    return NetworkCamera(stream, port=port)


def laboratory_of(folder, sequence, keys):
    """A recording.toml with the rig of a sequence, and TOML keys of some of its cameras."""
    write_rig(folder / "rig.toml", open_recording(sequence).rig.select(list(keys)))
    tables = "".join(f"[cameras.{name}]\n{text}\n" for name, text in keys.items())
    path = folder / "recording.toml"
    path.write_text(f'version = 1\ncalibration = "rig.toml"\n{tables}')
    return path


def wait_for_lines(path, count):
    wait_until(lambda: path.exists() and path.read_text().count("\n") >= count)


def free_port():
    """A port at which nobody listens."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def rows_of(frame, num_drones=4):
    """Rows of an instant, which differ from frame to frame."""
    shape = (1, num_drones, 3)
    return Trajectories(
        np.array([frame]),
        np.array([frame / 25]),
        tuple(map(str, range(num_drones))),
        np.random.default_rng(frame).normal(size=shape),
        velocity_m_s=np.ones(shape),
        status=np.full(shape[:2], int(Status.TRACKED)),
        covariance_m2=np.tile(np.eye(3), (1, num_drones, 1, 1)),
    )


# --- streams


@pytest.fixture
def cameras():
    """Cameras that are stopped after the test."""
    made = []
    yield made
    for camera in made:
        if not camera.has_ended:
            camera.stop()


@pytest.fixture
def taken(cameras):
    """Gives the frames of a stream until it breaks off, their ages when they are taken, and what is said."""

    def take(parts, at_s, work_s=0.0, kind=MJPEG):
        camera = NetworkCamera(timed(parts, at_s), kind)
        cameras.append(camera)
        frames, ages_s, lines = [], [], []
        source = CameraStream(camera.address, SMALL_WH).frames(lambda: 0.0, lambda: False)
        with contextlib.closing(source):
            for frame in source:
                if isinstance(frame, SourceFrame):
                    frames.append(frame)
                    ages_s.append(time.monotonic() - frame.arrived_s)
                    time.sleep(work_s)
                else:
                    lines.append(frame)
                    if "broken off" in frame:
                        return frames, ages_s, lines
        raise AssertionError("a stream that breaks off is tried again")

    return take


@pytest.mark.slow
def test_a_stream_without_times_of_its_own_says_so_once_and_loses_no_frame(taken):
    """FFmpeg invents 25 frames per second for images over HTTP; the program takes longer than the camera.

    Found: a frame that could be read at once was taken for one that had waited, and left out. Frames that have waited
    tell their age, so that a session leaves them out: in the buffers of a stream, they looked as new as the last one.
    """
    width, height = SMALL_WH
    parts = [jpeg_part(np.full((height, width, 3), 2 * number, np.uint8)) for number in range(60)]
    # Five frames together: four of them are there when they are asked for.
    at_s = np.arange(60) // 5 * 5 / 12
    frames, ages_s, lines = taken(parts, at_s, work_s=0.1)
    # The last image is complete only when the next one begins.
    assert len(frames) >= 59
    levels = [frame.image.mean() for frame in frames]
    assert np.abs(np.diff(levels) - 2).max() < 1.5
    # 59 frames that take 17 ms longer than they are apart.
    assert ages_s[-1] > 0.5
    assert len([line for line in lines if "frames are timed when they arrive" in line]) == 1
    assert all(frame.time_s == frame.arrived_s for frame in frames)


@pytest.mark.slow
def test_the_times_of_a_stream_are_used_and_said(taken, tmp_path, caplog):
    """A Matroska stream has times; its packets come late by up to 30 ms."""
    path, count = tmp_path / "film.mkv", 150
    width, height = SMALL_WH
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(f"{path}", cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SMALL_WH)
    for _ in range(count):
        writer.write(rng.integers(0, 255, (height, width, 3), np.uint8))
    writer.release()
    # Each part ends with the end of a JPEG image.
    parts = re.findall(rb".+?\xff\xd9|.+", path.read_bytes(), re.DOTALL)
    assert len(parts) == count + 1
    late_s = rng.exponential(0.012, count + 1).clip(max=0.03)
    with caplog.at_level("INFO", "psotrack"):
        frames, _, lines = taken(parts, np.arange(count + 1) / 25 + late_s, kind="video/x-matroska")
    assert any(line.endswith(": frames are timed by the stream") for line in caplog.messages)
    assert not [line for line in lines if "when they arrive" in line]
    # Where a frame that is less late than all before comes, the times go back by the difference.
    apart_s = np.diff([frame.time_s for frame in frames[-40:]])
    assert np.median(np.abs(apart_s - 1 / 25)) < 0.0006  # the stream's times are whole milliseconds
    arrived_apart_s = np.diff([frame.arrived_s for frame in frames[-40:]])
    assert np.median(np.abs(arrived_apart_s - 1 / 25)) > 0.004


def client():
    """Clients of WebSockets, if they are installed."""
    return pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")


# --- sessions


def make_sequence(folder):
    """A simulated flight of four drones."""
    recipe = change_scenario(scenario("S02_D4_A"), {"cameras": "laboratory_corners"})
    settings = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    simulate(recipe, folder, settings, jobs=1)


sequence = made_once("live_sequence", make_sequence, "Simulated_Data/S02_D4_A")


@pytest.fixture
def cache(tmp_path_factory):
    return tmp_path_factory.getbasetemp() / "live_cache"


@pytest.fixture
def meanwhile():
    """Does something in a thread while the test runs, and raises its error at the end of the test."""
    done = []

    def end_the_session(future):
        # The session in the main thread would wait for ever.
        if future.exception() is not None:
            os.kill(os.getpid(), signal.SIGINT)

    def start(work):
        done.append(pool.submit(work))
        done[-1].add_done_callback(end_the_session)

    with ThreadPoolExecutor() as pool:
        yield start
    for future in done:
        future.result()


@contextlib.contextmanager
def datagrams():
    """The address of a receiver, and what has come to it when the block ends."""
    sent = list[str]()

    def take():
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
    sequence, cache, tmp_path, run_psotrack, meanwhile
):
    keys = {name: f'video = "{sequence / name}i_s.avi"\n' for name in CAMERAS}
    # Two of the cameras have rolling shutters: a frame has the time of its middle row, 2.7 ms after its first row.
    for name in CAMERAS[:2]:
        keys[name] += "line_time_s = 2e-5"
    recording = laboratory_of(tmp_path, sequence, keys)
    common = ["--cache", cache, *EFFORT]
    port, received = free_port(), list[str]()

    def answers():
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", port)) == 0

    def listen():
        wait_until(answers)
        assert listening_at(os.getpid()) == {"127.0.0.1"}
        with client().connect(f"ws://127.0.0.1:{port}") as connection:
            received.extend(connection)

    client()
    meanwhile(listen)
    with datagrams() as (address, sent):
        # Slow enough for a machine that is busy with other tests.
        live = run_psotrack(
            *("live", recording, "--replay", "--speed", SPEED, "--out", tmp_path / "live.csv", "--lines"),
            *("--udp", address, "--websocket", port, "--record", tmp_path / "kept", *common),
        ).ended()
    assert f"rows are sent to clients of ws://127.0.0.1:{port}\n" in live.err
    assert sent == live.out.splitlines()
    # The client may come after the first rows.
    assert received == sent[-len(received) :]
    rows = [json.loads(line) for line in sent]
    columns = {"frame", "time_s", "drone", "position_m", "velocity_m_s", "covariance_m2", "status"}
    assert set(rows[0]) == columns
    assert np.shape(rows[0]["covariance_m2"]) == (3, 3)
    frames = [row["frame"] for row in rows]
    assert frames == sorted(frames)
    assert rows[-1]["status"] == "tracked"
    assert {row["drone"] for row in rows} >= {"0", "1", "2"}

    record = json.loads((tmp_path / "live.json").read_text())
    assert record["websocket"] == {"clients": 1}
    assert record["frames"] == NUM_FRAMES
    assert record["frames_left_out"] == 0
    assert record["late_searches"] is None
    for camera in record["camera_frames"].values():
        assert camera["left_out"] == 0
    # The last frame comes when all others are over.
    fastest = float(SPEED) * NUM_FRAMES / (NUM_FRAMES - 1)
    assert 0 < record["real_time_factor"] < record["real_time_factor_running"] <= fastest
    run_psotrack("track", recording, "--causal", "--out", tmp_path / "off.csv", *common).ended()
    assert (tmp_path / "live.csv").read_bytes() == (tmp_path / "off.csv").read_bytes()
    twin = json.loads((tmp_path / "off.json").read_text())
    same = ("sequence", "causal", "cameras", "rate_hz", "settings", "seed", "volume", "drones", "versions")
    for key in same:
        assert record[key] == twin[key], key

    kept = open_recording(tmp_path / "kept" / "recording.toml")
    source = open_recording(recording)
    for name in CAMERAS:
        counts = record["recorded"][name]
        assert counts["frames"] + counts["left_out"] == NUM_FRAMES
        assert kept.videos[name].num_frames == counts["frames"]
        # A busy machine leaves frames out; the others have the times at which they were filmed.
        assert counts["frames"] >= 0.8 * NUM_FRAMES
        filmed_s = source.by_name[name].times.time_s
        assert np.isin(kept.by_name[name].times.time_s, filmed_s).all()


def filmed_by(videos):
    """TOML keys of the cameras with these videos."""
    return {name: f"video = {video}\nfps = 10" for name, video in zip(CAMERAS, videos, strict=True)}


@pytest.mark.slow
def test_cameras_stop_come_back_are_missing_or_send_another_size(
    sequence, cache, tmp_path, cameras, run_psotrack, meanwhile, caplog
):
    """One camera breaks off and comes back, a device is not there, and a camera sends another size."""
    cameras += [film(sequence / "cam1i_s.avi"), film(sequence / "cam2i_s.avi")]
    cameras.append(NetworkCamera(lambda: iter([jpeg_part(np.zeros((48, 64, 3), np.uint8))] * 9)))
    wrong = cameras[2].address.replace("http://", "http://me:secret@")
    videos = [f'"{cameras[0].address}"', f'"{cameras[1].address}"', "63", f'"{wrong}"']
    laboratory, table = laboratory_of(tmp_path, sequence, filmed_by(videos)), tmp_path / "live.csv"

    def stop_and_film():
        wait_for_lines(table, 20)
        gone = cameras[1]
        gone.stop()
        wait_until(lambda: any("has broken off" in line for line in caplog.messages))
        wait_for_lines(table, table.read_text().count("\n") + 20)
        cameras.append(film(sequence / "cam2i_s.avi", gone.server_address[1]))
        wait_until(lambda: "camera cam2 films again" in caplog.messages)
        wait_for_lines(table, table.read_text().count("\n") + 20)
        os.kill(os.getpid(), signal.SIGINT)

    meanwhile(stop_and_film)
    done = run_psotrack(
        *("live", laboratory, "--out", table, "--record", tmp_path / "kept", "--cache", cache, *EFFORT)
    ).ended()
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
    sequence, cache, tmp_path, cameras, run_psotrack, caplog
):
    cameras.append(film(sequence / "cam1i_s.avi"))
    silent = f"http://127.0.0.1:{free_port()}/"
    videos = filmed_by([f'"{cameras[0].address}"', f'"{silent}"', "63", "63"])
    laboratory = laboratory_of(tmp_path, sequence, videos)
    done = run_psotrack(
        *("live", laboratory, "--out", tmp_path / "live.csv", "--record", tmp_path / "kept"),
        *("--cache", cache, *EFFORT),
    ).ended(2)
    last = "expected at least two cameras that film, found 1 of 4; the lines above say why"
    assert done.err == f"psotrack: the cameras: {last}\n"
    said = "\n".join(caplog.messages)
    for expected in (f"cam2: expected frames of {silent}", "cam3: expected frames of device 63"):
        assert said.count(f"camera {expected}, found") == 1
    # Nothing is in the way of the next attempt, but what cam1 has filmed is kept.
    assert not list(tmp_path.glob("live*"))


@pytest.mark.slow
def test_a_camera_whose_process_dies_is_one_line_and_the_others_go_on(sequence, caplog):
    recording = open_recording(sequence)
    effort = TrackSettings().changed({"swarm.particles": 20, "swarm.iterations": 15})
    cameras = live_cameras(recording, replay=True, speed=float(SPEED))
    session = LiveSession(recording, cameras, effort, most_drones=1, wait_s=0.5)

    def kill_one(result):
        if result.instants == 5:
            multiprocessing.active_children()[0].kill()

    result = session.run([lambda rows: None], kill_one)
    (line,) = (line for line in caplog.messages if "process" in line)
    assert ": expected frames, found that the camera's process died; is memory short?" in line
    assert result.instants == NUM_FRAMES
    assert sorted(state.counts.frames for state in result.cameras.values())[1:] == [NUM_FRAMES] * 3


#: Name of the case -> options, and words of the line.
BAD = {
    "no output": (["--replay"], "--out: expected --out FILE, --lines, --udp, --websocket or --view"),
    "files": (["--lines"], "the number of a device as `video`, found none; --replay plays the videos"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_done_is_one_line(name, flight, tmp_path, monkeypatch, run_psotrack):
    options, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PSOTRACK_CACHE", str(flight.parent / "cache"))
    assert_refused(lambda: run_psotrack("live", flight, *options), words, unchanged=tmp_path)


# --- What goes wrong


def first_line(address):
    """What a source says first."""
    with contextlib.closing(CameraStream(address, (64, 48)).frames(time.monotonic, lambda: False)) as source:
        return next(source)


def test_each_reason_why_a_stream_is_silent_is_said(cameras, monkeypatch):
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


def test_each_reason_why_a_device_is_silent_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("psotrack.live.sources._AGAIN_S", 0.0)
    file = tmp_path / "video0"
    file.touch()
    expected = f"expected frames of device {file}, found no such camera, or another program that uses it"
    assert first_line(f"device {file}") == f"{expected}; {AGAIN}"
    # Root may open every file.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert f"found no permission for {file}; is this user in the group" in first_line(f"device {file}")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_other_outputs_go_on_where_disks_are_full(
    sequence, cache, tmp_path, run_psotrack, monkeypatch, caplog
):
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


def test_an_unreachable_network_stops_nothing(caplog):
    # The system refuses to send to all hosts unless a program asks for it.
    with contextlib.closing(UdpLines("255.255.255.255:9")) as udp:
        for frame in range(3):
            udp.write(rows_of(frame))
    # Once, not at every instant.
    found = "expected to send rows, found permission denied; tracking goes on"
    assert caplog.messages == [f"--udp 255.255.255.255:9: {found}"]


def test_a_signal_that_comes_while_another_one_stops_the_session(flight):
    """A signal handler that interrupted itself waited for ever."""
    recording = open_recording(flight)
    session = LiveSession(recording, live_cameras(recording, replay=True), TrackSettings())
    before = signal.signal(signal.SIGINT, lambda *_: session.stop())
    is_over = threading.Event()

    def send():
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


# --- clients of WebSockets


@pytest.fixture
def port():
    client()
    return free_port()


@pytest.fixture
def server(port):
    server = WebSocketLines(f"{port}")
    yield server
    server.close()


def connected(port, server, **options):
    """A client, once the server knows it."""
    before = server.num_clients
    connection = client().connect(f"ws://127.0.0.1:{port}", **options)
    wait_until(lambda: server.num_clients > before)
    return connection


def deaf_client(port, server):
    """A client that connects and never reads a message."""
    before = server.num_clients
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.connect(("127.0.0.1", port))
    one.sendall(
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    wait_until(lambda: server.num_clients > before)
    return one


def test_all_clients_get_every_row_as_a_message_before_the_end(port):
    server = WebSocketLines(f"127.0.0.1:{port}")
    server.write(rows_of(0))  # nobody listens yet
    with connected(port, server) as first, connected(port, server) as second:
        for frame in range(1, 31):
            server.write(rows_of(frame))
        closing = threading.Thread(target=server.close)
        closing.start()
        expected = [line for frame in range(1, 31) for line in lines_of(rows_of(frame))]
        assert [*first] == expected
        assert [*second] == expected
        closing.join()
    row = json.loads(expected[0])
    assert row["frame"] == 1
    assert np.allclose(row["position_m"], rows_of(1).position_m[0, 0])


def test_a_client_that_never_reads_is_disconnected_and_slows_nobody(port):
    server = WebSocketLines(f"{port}", asked_s=0.4)
    num_bytes = frame = 0
    with contextlib.closing(server), deaf_client(port, server) as deaf, connected(port, server) as connection:
        # For longer than it takes to ask a client and to wait for its answer.
        ends_s = time.monotonic() + 1.6
        while time.monotonic() < ends_s:
            rows = rows_of(frame, num_drones=16)
            server.write(rows)
            frame += 1
            received = [connection.recv(timeout=10) for _ in range(16)]
            assert received == lines_of(rows)
            num_bytes += sum(map(len, received))
        deaf.settimeout(10)
        num_read = 0
        with contextlib.suppress(ConnectionResetError):
            # To the end of the connection, which came before the last rows.
            while received := deaf.recv(2**20):
                num_read += len(received)
        assert num_read < 0.9 * num_bytes


def test_a_client_that_does_not_read_cannot_hold_up_the_end(port):
    server = WebSocketLines(f"{port}")
    with deaf_client(port, server):
        # More than the system's buffers take, and less than what may wait in the server, so that it is connected.
        for frame in range(10):
            server.write(rows_of(frame, num_drones=200))
        # A second for the client to close; a server that waits for it would never end.
        server.close()


def test_only_pages_of_this_computer_may_read(port, server):
    with connected(port, server, origin="http://localhost:8000") as connection:
        server.write(rows_of(0, 1))
        assert json.loads(connection.recv(timeout=10))["frame"] == 0
    with pytest.raises(client().InvalidStatus, match="403"):
        client().connect(f"ws://127.0.0.1:{port}", origin="https://example.com")


NO_ADDRESSES = ("", "nowhere", "127.0.0.1:", "9000:", "0", "70000", "1.5", "٣")


def test_an_address_that_is_none_a_port_in_use_and_a_missing_package_are_one_line(
    port, server, tmp_path, monkeypatch
):
    refusals = {key: ["--websocket: expected PORT or HOST:PORT"] for key in NO_ADDRESSES}
    refusals["no.such.host.invalid:9000"] = ["expected an address of this computer"]
    refusals[f"{port}"] = ["expected an address of this computer that is free", "in use"]
    for address, words in refusals.items():
        assert_refused(lambda address=address: WebSocketLines(address), *words, unchanged=tmp_path)
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    assert_refused(lambda: WebSocketLines("9000"), "pip install '.[live]'", unchanged=tmp_path)
