"""Rows by WebSocket: real clients over real sockets, also one that never reads."""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_refused
from network_cameras import free_port, wait_until

from psotrack.live import WebSocketLines, lines_of
from psotrack.trajectories import Status, Trajectories

client = pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")
exceptions = pytest.importorskip("websockets.exceptions")


def rows_of(frame: int, num_drones: int = 4) -> Trajectories:
    generator = np.random.default_rng(frame)
    return Trajectories(
        frame=np.array([frame]),
        time_s=np.array([frame / 25]),
        drones=tuple(f"{drone}" for drone in range(num_drones)),
        position_m=generator.normal(size=(1, num_drones, 3)),
        velocity_m_s=generator.normal(size=(1, num_drones, 3)),
        fitness=np.ones((1, num_drones)),
        num_cameras=np.full((1, num_drones), 4),
        status=np.full((1, num_drones), int(Status.TRACKED)),
        covariance_m2=np.broadcast_to(np.eye(3), (1, num_drones, 3, 3)).copy(),
    )


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def server(port: int) -> Iterator[WebSocketLines]:
    server = WebSocketLines(f"{port}")
    yield server
    server.close()


def connected(port: int, server: WebSocketLines, **options: object):
    """A client, once the server knows it."""
    before = server.num_clients
    connection = client.connect(f"ws://127.0.0.1:{port}", **options)
    wait_until(lambda: server.num_clients > before, "the server does not know its client")
    return connection


def deaf_client(port: int, server: WebSocketLines) -> socket.socket:
    """A client that connects and never reads a message."""
    before = server.num_clients
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.connect(("127.0.0.1", port))
    one.sendall(
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    wait_until(lambda: server.num_clients > before, "the server does not know its client")
    return one


def test_all_clients_get_every_row_as_a_message(port: int, server: WebSocketLines) -> None:
    server.write(rows_of(0))  # nobody listens yet
    with connected(port, server) as first, connected(port, server) as second:
        for frame in range(1, 11):
            server.write(rows_of(frame))
        expected = [line for frame in range(1, 11) for line in lines_of(rows_of(frame))]
        for connection in (first, second):
            assert [connection.recv(timeout=10) for _ in expected] == expected
    row = json.loads(expected[0])
    assert row["frame"] == 1
    assert row["status"] == "tracked"
    assert np.allclose(row["position_m"], rows_of(1).position_m[0, 0])


def test_a_client_that_never_reads_is_disconnected_and_slows_nobody(port: int) -> None:
    server, num_bytes, frame = WebSocketLines(f"{port}", asked_s=0.5), 0, 0
    with contextlib.closing(server), deaf_client(port, server) as deaf, connected(port, server) as connection:
        # For longer than it takes to ask a client and to wait for its answer.
        ends_s = time.monotonic() + 2.0
        while time.monotonic() < ends_s:
            rows, frame = rows_of(frame, num_drones=16), frame + 1
            server.write(rows)
            received = [connection.recv(timeout=10) for _ in range(16)]
            assert received == lines_of(rows)
            num_bytes += sum(map(len, received))
        deaf.settimeout(10)
        with contextlib.suppress(ConnectionResetError):
            # To the end of the connection, which came before the last rows.
            assert len(b"".join(iter(lambda: deaf.recv(2**20), b""))) < 0.9 * num_bytes


def test_a_client_that_does_not_read_cannot_hold_up_the_end(port: int) -> None:
    server = WebSocketLines(f"{port}")
    with deaf_client(port, server):
        # More than the system's buffers take, and less than what may wait in the server, so that it is connected.
        for frame in range(10):
            server.write(rows_of(frame, num_drones=200))
        # A second for the client to close; a server that waits for it would never end.
        server.close()


def test_clients_that_vanish_do_no_harm(port: int, server: WebSocketLines) -> None:
    vanished = deaf_client(port, server)
    # A reset instead of an orderly end.
    vanished.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    vanished.close()
    with socket.create_connection(("127.0.0.1", port)) as stranger:
        stranger.sendall(b"this is no WebSocket client\r\n\r\n")
    with connected(port, server) as connection:
        for frame in range(5):
            server.write(rows_of(frame, 1))
        assert [json.loads(connection.recv(timeout=10))["frame"] for _ in range(5)] == list(range(5))


def test_the_last_rows_come_before_the_end(port: int) -> None:
    server = WebSocketLines(f"127.0.0.1:{port}")
    with connected(port, server) as connection:
        for frame in range(30):
            server.write(rows_of(frame, 1))
        closing = threading.Thread(target=server.close)
        closing.start()
        assert [json.loads(message)["frame"] for message in connection] == list(range(30))
        closing.join()


def test_only_pages_of_this_computer_may_read(port: int, server: WebSocketLines) -> None:
    with connected(port, server, origin="http://localhost:8000") as connection:
        server.write(rows_of(0, 1))
        assert json.loads(connection.recv(timeout=10))["frame"] == 0
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        client.connect(f"ws://127.0.0.1:{port}", origin="https://example.com")


#: Name of the case -> address, and words of the line.
BAD = {
    "nothing": ("", "--websocket: expected PORT or HOST:PORT"),
    "a word": ("nowhere", "--websocket: expected PORT or HOST:PORT"),
    "no port": ("127.0.0.1:", "--websocket: expected PORT or HOST:PORT"),
    "no host": ("9000:", "--websocket: expected PORT or HOST:PORT"),
    "port 0": ("0", "--websocket: expected PORT or HOST:PORT"),
    "a large port": ("70000", "--websocket: expected PORT or HOST:PORT"),
    "a part of a port": ("1.5", "--websocket: expected PORT or HOST:PORT"),
    "an Arabic digit": ("٣", "--websocket: expected PORT or HOST:PORT"),
    "an unknown host": ("no.such.host.invalid:9000", "expected an address of this computer"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_address_that_is_none(name: str, tmp_path: Path) -> None:
    address, words = BAD[name]
    assert_refused(lambda: WebSocketLines(address), words, unchanged=tmp_path)


def test_a_port_in_use_is_one_line(port: int, server: WebSocketLines, tmp_path: Path) -> None:
    words = "expected an address of this computer that is free", "in use"
    assert_refused(lambda: WebSocketLines(f"{port}"), *words, unchanged=tmp_path)


def test_without_the_package_the_error_says_how_to_install_it(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    assert_refused(lambda: WebSocketLines("9000"), "pip install '.[live]'", unchanged=tmp_path)
