"""Rows by WebSocket: one text message of JSON per drone and instant, to all clients that are connected.

The server is that of the package `websockets`, in a thread of its own, so that tracking never waits for a client. Rows
for a client that reads slowly, or not at all, wait in memory, and behind them the server's question for an answer:
a client that does not answer in time is disconnected.
"""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from typing import TYPE_CHECKING

from psotrack.errors import OutputError, SettingsError, install_command
from psotrack.live.messages import host_and_port, lines_of
from psotrack.trajectories import Trajectories

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection

logger = logging.getLogger(__name__)

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
