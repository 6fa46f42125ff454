"""`psotrack live`: replayed files give the tracks of `track --causal`; cameras on the network stop and come back."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

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
)

from psotrack.datasets import open_recording
from psotrack.trajectories import Trajectories, read_trajectories

pytestmark = pytest.mark.slow


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


def test_a_replay_without_losses_gives_the_tracks_of_the_offline_twin(
    sequence: Path, cache: Path, tmp_path: Path
) -> None:
    common = ["--cameras", ",".join(CAMERAS), "--cache", cache, *EFFORT]
    offline = psotrack("track", sequence, "--causal", "--out", tmp_path / "offline.csv", *common)
    assert offline.returncode == 0, offline.stderr
    # Slow enough for a machine that is busy with other tests.
    live = psotrack("live", sequence, "--replay", "--speed", "0.2", "--out", tmp_path / "live.csv", *common)
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
    short = psotrack("track", sequence, "--causal", "--frames", 70, "--out", tmp_path / "short.csv", *common)
    assert short.returncode == 0, short.stderr
    assert (tmp_path / "live.csv").read_text().startswith((tmp_path / "short.csv").read_text())


def _take_datagrams(receiver: socket.socket, taken: list[str]) -> None:
    """Take datagrams, until one says that it is the end."""
    while (text := receiver.recv(65536).decode()) != "end":
        taken.append(text)


def test_rows_come_as_lines_and_by_udp(sequence: Path, cache: Path, tmp_path: Path) -> None:
    sent: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        # Taken as they come: the system keeps only some hundred of them.
        taking = threading.Thread(target=_take_datagrams, args=(receiver, sent))
        taking.start()
        try:
            done = psotrack(
                "live", sequence, "--replay", "--speed", "0.2", "--lines",
                "--udp", f"127.0.0.1:{receiver.getsockname()[1]}",
                "--cameras", ",".join(CAMERAS), "--cache", cache, *EFFORT,
            )  # fmt: skip
        finally:
            receiver.sendto(b"end", receiver.getsockname())
            taking.join()
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines
    assert sent == lines
    rows = [json.loads(line) for line in lines]
    assert set(rows[0]) == {
        *("frame", "time_s", "drone", "position_m", "velocity_m_s", "covariance_m2", "status")
    }
    assert np.shape(rows[0]["covariance_m2"]) == (3, 3)
    assert [row["frame"] for row in rows] == sorted(row["frame"] for row in rows)


def test_rows_come_by_websocket(sequence: Path, cache: Path, tmp_path: Path) -> None:
    client = pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")
    port = free_port()
    # A pipe that nobody reads takes 64 KiB, and then stops the program.
    lines = tmp_path / "lines.txt"
    with lines.open("w") as out:
        live = subprocess.Popen(
            [
                *(sys.executable, "-m", "psotrack", "live", f"{sequence}", "--replay", "--speed", "0.2"),
                *("--websocket", f"{port}", "--lines", "--json", f"{tmp_path / 'live.json'}"),
                *("--cameras", ",".join(CAMERAS), "--cache", f"{cache}", *EFFORT),
            ],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
    for _ in range(1200):
        with socket.socket() as one:
            if one.connect_ex(("127.0.0.1", port)) == 0:
                break
        assert live.poll() is None, live.communicate()
        time.sleep(0.1)
    assert listening_at(live.pid) == {"127.0.0.1"}
    # The server listens before anything is compiled, so a client that comes then gets all rows.
    with client.connect(f"ws://127.0.0.1:{port}") as connection:
        received = list(connection)
    _, err = live.communicate(timeout=60)
    assert live.returncode == 0, err
    assert f"rows are sent to clients of ws://127.0.0.1:{port}\n" in err
    assert received == lines.read_text().splitlines()
    assert received, (tmp_path / "live.json").read_text()
    assert json.loads(received[-1])["status"] == "tracked"
    assert json.loads((tmp_path / "live.json").read_text())["websocket"] == {"clients": 1}


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
        assert set(kept.frame_times[name].time_s) <= set(source.frame_times[name].time_s)
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
    refused = psotrack(
        "live", sequence, "--replay", "--lines", "--record", tmp_path / "kept", "--cache", cache, *EFFORT
    )
    assert refused.returncode == 2
    assert (
        "kept: expected a new or an empty folder, found a folder with files; pass --force" in refused.stderr
    )


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


def test_a_session_that_crashed_is_tracked_again(sequence: Path, cache: Path, tmp_path: Path) -> None:
    """All processes of a session are killed at once, as a power cut does."""
    options = ["--cameras", ",".join(CAMERAS), "--cache", f"{cache}", *EFFORT]
    kept, table = tmp_path / "kept", tmp_path / "live.csv"
    with subprocess.Popen(
        [
            *(sys.executable, "-m", "psotrack", "live", f"{sequence}", "--replay", "--speed", "0.3", "--loops", "9"),
            *("--out", f"{table}", "--record", f"{kept}", *options),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as live:  # fmt: skip
        # 32 KiB of a video have not reached the file.
        for _ in range(1200):
            sizes = [path.stat().st_size for path in kept.glob("*.avi")]
            num_rows = table.read_text().count("\n") if table.exists() else 0
            if len(sizes) == len(CAMERAS) and min(sizes) > 150_000 and num_rows > 60:
                break
            assert live.poll() is None, live.communicate()
            time.sleep(0.1)
        os.killpg(live.pid, signal.SIGKILL)
    assert min(sizes) > 150_000
    # Four drones at most: no row has waited to be written.
    assert read_trajectories(table).num_frames >= 15
    again = psotrack("track", kept, "--out", tmp_path / "again.csv", "--cache", cache, *EFFORT)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("the video was not finished") == len(CAMERAS)
    assert read_trajectories(tmp_path / "again.csv").num_drones >= 3


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


def test_a_stream_that_does_not_answer_is_one_line(
    sequence: Path, cache: Path, tmp_path: Path, cameras: Cameras
) -> None:
    names = CAMERAS[:3]
    ports = [free_port() for _ in names]
    for name, port in zip(names[1:], ports[1:], strict=True):
        film(cameras, sequence / f"{name}i_s.avi", port)
    addresses = {name: f"http://127.0.0.1:{port}/" for name, port in zip(names, ports, strict=True)}
    laboratory = laboratory_of(tmp_path, sequence, addresses)
    done = psotrack(
        "live", laboratory, "--out", tmp_path / "live.csv", "--cache", cache, "--seconds", "8", *EFFORT
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("does not answer") == 1
    assert "has stopped" not in done.stderr
    record = json.loads((tmp_path / "live.json").read_text())
    assert record["camera_frames"][names[0]]["frames"] == 0
    assert record["camera_frames"][names[1]]["frames"] > 10


def test_a_camera_of_another_size_is_left_out_and_none_ends_the_command(
    sequence: Path, cache: Path, tmp_path: Path, cameras: Cameras
) -> None:
    port = free_port()
    small = tmp_path / "small.avi"
    simulate_small = textwrap.dedent("""
        import cv2, sys
        writer = cv2.VideoWriter(sys.argv[1], cv2.VideoWriter.fourcc(*"XVID"), 10, (64, 48))
        import numpy as np
        for level in range(30):
            writer.write(np.full((48, 64, 3), level, np.uint8))
        writer.release()
    """)
    subprocess.run([sys.executable, "-c", simulate_small, str(small)], check=True)
    film(cameras, small, port)
    laboratory = laboratory_of(
        tmp_path, sequence, {name: f"http://127.0.0.1:{port}/{name}" for name in CAMERAS[:2]}
    )
    done = psotrack("live", laboratory, "--lines", "--cache", cache, "--seconds", "20", *EFFORT)
    assert done.returncode == 2
    assert "expected images of 672 x 378 pixels, as the rig says, found 64 x 48" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--replay"], "--out: expected --out FILE, --lines, --udp, --websocket or --view"),
        (["--lines"], "expected at least two cameras of the rig with the address of a stream"),
        (["--replay", "--out", "tracks.txt"], "ends in .csv or .parquet"),
        (["--replay", "--udp", "nowhere"], "--udp: expected HOST:PORT"),
        (["--replay", "--websocket", "nowhere"], "--websocket: expected PORT or HOST:PORT"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    sequence: Path, cache: Path, tmp_path: Path, options: list[str], words: str
) -> None:
    copy = shutil.copytree(sequence, tmp_path / "copy")
    done = psotrack("live", copy, "--cache", cache, *options, cwd=tmp_path, env=dict(os.environ))
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
