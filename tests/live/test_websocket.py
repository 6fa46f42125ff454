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
from network_cameras import free_port, rows_of, wait_until

from psotrack.live import WebSocketLines, lines_of

client = pytest.importorskip("websockets.sync.client", reason="needs the extra `live`")
exceptions = pytest.importorskip("websockets.exceptions")


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


def test_all_clients_get_every_row_as_a_message_before_the_end(port: int) -> None:
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
    assert (row["frame"], row["status"]) == (1, "tracked")
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


def test_only_pages_of_this_computer_may_read(port: int, server: WebSocketLines) -> None:
    with connected(port, server, origin="http://localhost:8000") as connection:
        server.write(rows_of(0, 1))
        assert json.loads(connection.recv(timeout=10))["frame"] == 0
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        client.connect(f"ws://127.0.0.1:{port}", origin="https://example.com")


#: Address -> words of the line.
BAD = {
    **dict.fromkeys(
        ("", "nowhere", "127.0.0.1:", "9000:", "0", "70000", "1.5", "٣"),
        "--websocket: expected PORT or HOST:PORT",
    ),
    "no.such.host.invalid:9000": "expected an address of this computer",
}


@pytest.mark.parametrize("address", BAD)
def test_an_address_that_is_none(address: str, tmp_path: Path) -> None:
    assert_refused(lambda: WebSocketLines(address), BAD[address], unchanged=tmp_path)


def test_a_port_in_use_is_one_line(port: int, server: WebSocketLines, tmp_path: Path) -> None:
    words = "expected an address of this computer that is free", "in use"
    assert_refused(lambda: WebSocketLines(f"{port}"), *words, unchanged=tmp_path)


def test_without_the_package_the_error_says_how_to_install_it(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    assert_refused(lambda: WebSocketLines("9000"), "pip install '.[live]'", unchanged=tmp_path)
