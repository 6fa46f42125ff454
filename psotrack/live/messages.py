"""Rows as messages: a line of JSON per drone and instant, on a stream of text, by UDP, or to clients of a WebSocket."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import threading
from typing import TYPE_CHECKING, TextIO

from psotrack.errors import OutputError, SettingsError, install_command
from psotrack.support import whole_number
from psotrack.trajectories import Status, Trajectories

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection


logger = logging.getLogger(__name__)

_VALUES = ("position_m", "velocity_m_s", "covariance_m2")


def lines_of(rows: Trajectories) -> list[str]:
    """One line of JSON for each drone: frame, time_s, drone, position_m, velocity_m_s, covariance_m2, status."""
    assert rows.status is not None
    at = {"frame": int(rows.frame[0]), "time_s": float(rows.time_s[0])}
    lines = []
    for index, drone in enumerate(rows.drones):
        values = {name: getattr(rows, name)[0, index].tolist() for name in _VALUES}
        status = Status(int(rows.status[0, index])).label
        lines.append(json.dumps({**at, "drone": drone, **values, "status": status}))
    return lines


def host_and_port(option: str, address: str, *, usual_host: str = "") -> tuple[str, int]:
    """Host and port of an address HOST:PORT.

    Args:
        option: the option that has the address, for messages.
        address: HOST:PORT, or PORT where there is a usual host.
        usual_host: the host of an address without one; empty where an address needs one.

    Raises:
        SettingsError: the address is none.
    """
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or usual_host
    if not host or not 0 < (whole_number(port) or 0) < 65536:
        expected = "HOST:PORT, such as 127.0.0.1:9000"
        raise SettingsError(option, expected=f"PORT or {expected}" if usual_host else expected, found=address)
    return host, int(port)


def write_lines(stream: TextIO, rows: Trajectories) -> None:
    """Write the rows of an instant to a stream of text, such as stdout.

    Raises:
        OutputError: the stream takes no more, because the disk is full for instance.
        BrokenPipeError: the program that reads the stream has ended.
    """
    try:
        stream.writelines(f"{line}\n" for line in lines_of(rows))
        stream.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(
            "--lines", expected="to write rows", found=f"{error.strerror or error}".lower()
        ) from error


class UdpLines:
    """Sends rows by UDP, a datagram per drone and instant.

    Args:
        address: HOST:PORT.

    Raises:
        SettingsError: the address is none.
    """

    def __init__(self, address: str) -> None:
        host, port = host_and_port("--udp", address)
        try:
            family, _, _, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise SettingsError("--udp", expected="a host that is known", found=host) from error
        self._address, self._target, self._said = address, target, ""
        self._socket = socket.socket(family, socket.SOCK_DGRAM)

    def write(self, rows: Trajectories) -> None:
        """Send the rows of an instant; where the network refuses them, say so once and go on: it may come back."""
        try:
            for line in lines_of(rows):
                self._socket.sendto(line.encode(), self._target)
        except ConnectionRefusedError:
            return  # nobody listens on this machine yet
        except OSError as error:
            found = f"{error.strerror or error}".lower()
            if found != self._said:
                text = "--udp %s: expected to send rows, found %s; tracking goes on"
                logger.warning(text, self._address, found)
            self._said = found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


#: How often a client is asked whether it is there, and time that it has to answer, seconds: in both together, rows of
#: sixteen drones at 25 per second take 6 MB of memory.
_ASKED_S = 10.0
#: Bytes that may wait for a client until the server itself waits for it: never, so that it is asked.
_NEVER = 2**40
#: Time for clients to take the last rows and to close the connection, seconds.
_CLOSE_S = 1.0
#: Largest message of a client, bytes: nothing is expected from clients.
_MOST_RECEIVED = 1024
#: Browsers let every web page connect to this computer, and say where the page is from: only pages of this computer may
#: read rows that are meant for this computer. Programs that are no browser do not say anything.
_OWN_PAGES = [None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")]
_OWN_HOSTS = {"127.0.0.1", "localhost", "::1"}
#: The package else shows a traceback for everyone who connects and is no WebSocket client.
_SILENT = logging.getLogger(f"{__name__}.server")
_SILENT.disabled = True


class WebSocketLines:
    """Sends rows to the clients of a WebSocket server, a message per drone and instant.

    The server is that of the package `websockets`, in a thread of its own, so that tracking never waits for a client.
    Rows for a client that reads slowly, or not at all, wait in memory, and behind them the server's question for an
    answer: a client that does not answer in time is disconnected.

    Args:
        address: PORT, which programs on this computer reach, or HOST:PORT, where HOST is an address of this computer.
        asked_s: how often a client is asked whether it is there, and time that it has to answer, seconds.

    Attributes:
        address: address for clients, such as ws://127.0.0.1:9000.
        num_clients: number of clients that have connected.

    Raises:
        SettingsError: the address is none, or the package `websockets` is not installed.
        OutputError: no server can listen there.
    """

    def __init__(self, address: str, *, asked_s: float = _ASKED_S) -> None:
        host, port = host_and_port("--websocket", address, usual_host="127.0.0.1")
        try:
            from websockets.asyncio.server import broadcast, serve
        except ModuleNotFoundError as error:
            expected, remedy = "the package websockets", install_command("live")
            raise SettingsError(
                "--websocket", expected=expected, found="it is not installed", remedy=remedy
            ) from error
        self.address = f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"
        self.num_clients = 0
        self._broadcast = broadcast
        self._loop = asyncio.new_event_loop()

        async def listen() -> Server:
            return await serve(
                self._talk,
                host,
                port,
                origins=_OWN_PAGES if host in _OWN_HOSTS else None,
                compression=None,
                ping_interval=asked_s,
                ping_timeout=asked_s,
                close_timeout=_CLOSE_S,
                max_size=_MOST_RECEIVED,
                write_limit=_NEVER,
                logger=_SILENT,
            )

        try:
            self._server = self._loop.run_until_complete(listen())
        except OSError as error:
            self._loop.close()
            expected, found = "an address of this computer that is free", f"{error.strerror or error}".lower()
            raise OutputError(f"--websocket {address}", expected=expected, found=found) from error
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def write(self, rows: Trajectories) -> None:
        """Hand over the rows of an instant; does not wait for any client."""
        self._loop.call_soon_threadsafe(self._send, lines_of(rows))

    def close(self) -> None:
        """Let clients take the last rows, for a second at most, and end the server."""
        self._loop.call_soon_threadsafe(self._server.close)
        asyncio.run_coroutine_threadsafe(self._server.wait_closed(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _send(self, lines: list[str]) -> None:
        for line in lines:
            self._broadcast(self._server.connections, line)

    async def _talk(self, connection: ServerConnection) -> None:
        self.num_clients += 1
        await connection.wait_closed()
