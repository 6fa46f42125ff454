"""Cameras on the network, as processes with real sockets, and a short flight that they film."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from helpers import make_once

from psotrack.geometry.rig_files import write_rig
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, simulate

#: Few, small cameras: a machine that is busy with other tests must keep up with the replay.
CAMERAS, NUM_FRAMES, SCALE = ("cam1", "cam3", "cam5", "cam7"), 90, 0.35
EFFORT = ["--particles", "20", "--iterations", "15"]
#: Processes of cameras by port.
Cameras = dict[int, subprocess.Popen[bytes]]

#: A camera on the network: sends the frames of a video again and again as JPEG images over HTTP, 10 per second, because
#: a busy machine must keep up.
_CAMERA = """
import http.server, itertools, sys, time
import cv2

path, port = sys.argv[1], int(sys.argv[2])
capture, images = cv2.VideoCapture(path), []
while True:
    there, frame = capture.read()
    if not there:
        break
    images.append(cv2.imencode(".jpg", frame)[1].tobytes())

class Camera(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        if self.path == "/nothing":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        while True:
            # All cameras show the same moment, as cameras of one room do.
            image = images[int(time.time() * 10) % len(images)]
            head = f"--frame\\r\\nContent-Type: image/jpeg\\r\\nContent-Length: {len(image)}\\r\\n\\r\\n"
            self.wfile.write(head.encode() + image + b"\\r\\n")
            time.sleep(0.1 - time.time() % 0.1)

    def log_message(self, *arguments):
        pass

http.server.ThreadingHTTPServer(("127.0.0.1", port), Camera).serve_forever()
"""


def live_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated flight of four drones; the same folder in all tests."""

    def make(folder: Path) -> None:
        settings = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
        simulate("S02_D4_A", folder, settings, jobs=2)

    return make_once(tmp_path_factory, "live_sequence", make) / "Simulated_Data" / "S02_D4_A"


def psotrack(*arguments: object, **more: object) -> subprocess.CompletedProcess[str]:
    """Run the program."""
    return python("-m", "psotrack", *arguments, **more)


def python(*arguments: object, **more: object) -> subprocess.CompletedProcess[str]:
    """Run Python."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **more},  # type: ignore[call-overload]
        text=True,
        timeout=300,
        check=False,
    )


def free_port() -> int:
    """A port at which nobody listens."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextlib.contextmanager
def film_on_the_network() -> Iterator[Cameras]:
    """Processes of cameras, which `film` starts; ended after the block."""
    processes: Cameras = {}
    try:
        yield processes
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


def film(processes: Cameras, video: Path, port: int) -> None:
    """Start a camera, and wait until it answers."""
    processes[port] = subprocess.Popen([sys.executable, "-c", _CAMERA, str(video), str(port)])
    wait_for_server(port, processes[port])


def wait_for_server(port: int, process: subprocess.Popen) -> None:
    """Wait until a process listens at a port."""
    for _ in range(1200):
        with socket.socket() as one:
            if one.connect_ex(("127.0.0.1", port)) == 0:
                return
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    raise AssertionError(f"nobody answers at port {port}")


def laboratory_of(folder: Path, sequence: Path, videos: Mapping[str, str | int]) -> Path:
    """A recording.toml of cameras with addresses or numbers of devices, with the rig of a sequence."""
    rig = open_recording(sequence).rig.select(list(videos))
    write_rig(folder / "rig.toml", rig)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for name, video in videos.items():
        lines += [f"[cameras.{name}]", f"video = {video}" if isinstance(video, int) else f'video = "{video}"']
        lines += ["fps = 10"]
    path = folder / "recording.toml"
    path.write_text("\n".join(lines) + "\n")
    return path
