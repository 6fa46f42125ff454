"""Cameras on the network with real sockets, a short flight that they film, and free ports."""

from __future__ import annotations

import http.server
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import make_once

from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import probe, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.trajectories import Status, Trajectories

#: Few, small cameras: a machine that is busy with other tests must keep up with the replay.
CAMERAS, NUM_FRAMES, SCALE = ("cam1", "cam2", "cam3", "cam4"), 40, 0.25
SIZE_WH = (480, 270)
#: A program is compiled for 1, 2 and 4 drones.
EFFORT = ["--particles", "20", "--iterations", "15", "--most-drones", "4"]
MJPEG = "multipart/x-mixed-replace; boundary=frame"


def live_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of four drones; the same folder in all tests."""

    def make(folder: Path) -> None:
        recipe = change_scenario(scenario("S02_D4_A"), {"cameras": "laboratory_corners"})
        settings = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
        simulate(recipe, folder, settings, jobs=1)

    return make_once(tmp_path_factory, "live_sequence", make) / "Simulated_Data" / "S02_D4_A"


class NetworkCamera(http.server.ThreadingHTTPServer):
    """A camera that sends the parts of a stream to each connection, in a thread of this process.

    Args:
        parts: makes the parts of one connection's stream, and sleeps between them.
        kind: type of the stream's content.
        port: port of this computer; 0 for a free one.
    """

    daemon_threads = True

    def __init__(self, parts: Callable[[], Iterable[bytes]], kind: str = MJPEG, port: int = 0) -> None:
        camera = self
        self.has_ended = False

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
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

            def log_message(self, *arguments: object) -> None:
                pass

        super().__init__(("127.0.0.1", port), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def stop(self) -> None:
        """End all connections, and answer no others."""
        self.has_ended = True
        self.shutdown()
        self.server_close()


def jpeg_part(image: np.ndarray) -> bytes:
    coded = cv2.imencode(".jpg", image)[1].tobytes()
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(coded)}\r\n\r\n"
    return head.encode() + coded + b"\r\n"


def timed(parts: list[bytes], at_s: np.ndarray) -> Callable[[], Iterator[bytes]]:
    """Parts that come at given times after a connection's beginning."""

    def stream() -> Iterator[bytes]:
        began_s = time.monotonic()
        for part, part_s in zip(parts, at_s.tolist(), strict=True):
            time.sleep(max(0.0, began_s + part_s - time.monotonic()))
            yield part

    return stream


def film(video: Path, port: int = 0) -> NetworkCamera:
    """A camera that sends the frames of a video again and again, 10 per second, as a busy machine must keep up."""
    parts = [jpeg_part(image) for image in read_frames(probe(video))]

    def stream() -> Iterator[bytes]:
        while True:
            # All cameras show the same moment, as cameras of one room do.
            yield parts[int(time.time() * 10) % len(parts)]
            time.sleep(0.1 - time.time() % 0.1)

    return NetworkCamera(stream, port=port)


def laboratory_of(folder: Path, sequence: Path, keys: Mapping[str, str]) -> Path:
    """A recording.toml with the rig of a sequence, and TOML keys of some of its cameras."""
    write_rig(folder / "rig.toml", open_recording(sequence).rig.select(list(keys)))
    tables = "".join(f"[cameras.{name}]\n{text}\n" for name, text in keys.items())
    path = folder / "recording.toml"
    path.write_text(f'version = 1\ncalibration = "rig.toml"\n{tables}')
    return path


def wait_until(condition: Callable[[], object], what: str) -> None:
    for _ in range(12_000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError(what)


def wait_for_lines(path: Path, count: int) -> None:
    wait_until(lambda: path.exists() and path.read_text().count("\n") >= count, f"no line {count} in {path}")


def free_port() -> int:
    """A port at which nobody listens."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def rows_of(frame: int, num_drones: int = 4) -> Trajectories:
    """Rows of an instant, which differ from frame to frame."""
    generator, shape = np.random.default_rng(frame), (1, num_drones, 3)
    return Trajectories(
        frame=np.array([frame]),
        time_s=np.array([frame / 25]),
        drones=tuple(f"{drone}" for drone in range(num_drones)),
        position_m=generator.normal(size=shape),
        velocity_m_s=generator.normal(size=shape),
        status=np.full(shape[:2], int(Status.TRACKED)),
        covariance_m2=np.tile(np.eye(3), (1, num_drones, 1, 1)),
    )
