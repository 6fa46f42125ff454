"""Rows by WebSocket: one text message of JSON per drone and instant, to all clients that are connected.

The server is that of the package `websockets`, in a thread of its own. Rows wait in a bounded queue for each client, so
that a client that reads slowly, or not at all, never slows tracking: its oldest rows are left out.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import socket
import threading
from collections import deque
from typing import TYPE_CHECKING

from psotrack.errors import OutputError, SettingsError
from psotrack.live.messages import lines_of
from psotrack.support import whole_number
from psotrack.trajectories import Trajectories

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection

logger = logging.getLogger(__name__)

#: Largest number of instants that wait for a client: two seconds at 25 per second.
_MOST_WAITING = 50
#: Time for clients to take the last rows, and then to close the connection, seconds.
_LAST_ROWS_S, _CLOSE_S = 1.0, 1.0
#: Largest message of a client, bytes: nothing is expected from clients.
_MOST_RECEIVED = 1024
#: Browsers let every web page connect to this computer, and say where the page is from: only pages of this computer may
#: read rows that are meant for this computer. Programs that are no browser do not say anything.
_OWN_PAGES = [None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")]
_OWN_HOSTS = {"127.0.0.1", "localhost", "::1"}


class _Client:
    """The rows that wait for a client: a list of messages per instant; None ends them."""

    def __init__(self) -> None:
        self.waiting: deque[list[str] | None] = deque()
        self.has_more = asyncio.Event()

    def put(self, messages: list[str] | None) -> None:
        self.waiting.append(messages)
        self.has_more.set()

    async def next(self) -> list[str] | None:
        while not self.waiting:
            self.has_more.clear()
            await self.has_more.wait()
        return self.waiting.popleft()


class WebSocketLines:
    """Sends rows to the clients of a WebSocket server, a message per drone and instant.

    Args:
        address: PORT, which programs on this computer reach, or HOST:PORT, where HOST is an address of this computer.

    Attributes:
        address: address for clients, such as ws://127.0.0.1:9000.
        num_clients: number of clients that have connected.
        left_out: messages that were left out, because a client read too slowly.

    Raises:
        SettingsError: the address is none, or the package `websockets` is not installed.
        OutputError: no server can listen there.
    """

    def __init__(self, address: str) -> None:
        host, port = _host_and_port(address)
        try:
            from websockets.asyncio.server import serve
        except ModuleNotFoundError as error:
            raise SettingsError(
                "--websocket",
                expected="the package websockets",
                found="it is not installed",
                remedy="pip install 'psotrack[live]'",
            ) from error
        self.address = f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"
        self.num_clients = self.left_out = 0
        self._clients: dict[_Client, ServerConnection] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

        async def listen() -> Server:
            return await serve(
                self._talk,
                host,
                port,
                origins=_OWN_PAGES if host in _OWN_HOSTS else None,
                compression=None,
                max_size=_MOST_RECEIVED,
                close_timeout=_CLOSE_S,
                logger=_silent_logger(),
            )

        try:
            self._server = asyncio.run_coroutine_threadsafe(listen(), self._loop).result()
        except OSError as error:
            self._end_thread()
            # asyncio's own words for a port in use repeat the address.
            is_unknown = isinstance(error, socket.gaierror)
            reason = error.strerror if is_unknown else os.strerror(error.errno or 0)
            raise OutputError(
                f"--websocket {address}",
                expected="an address of this computer that is free",
                found=(reason or f"{error}").lower(),
            ) from error

    def write(self, rows: Trajectories) -> None:
        """Hand over the rows of an instant; does not wait for any client."""
        if self._clients and (messages := lines_of(rows)):
            self._loop.call_soon_threadsafe(self._offer, messages)

    def close(self) -> None:
        """Let clients take the last rows, for a second at most, and end the server."""
        if not self._loop.is_closed():
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
            self._end_thread()

    def _offer(self, messages: list[str]) -> None:
        for client in self._clients:
            if len(client.waiting) >= _MOST_WAITING:
                left_out = client.waiting.popleft()
                self.left_out += len(left_out or [])
                logger.warning("a client of --websocket reads too slowly: rows are left out for it")
            client.put(messages)

    async def _talk(self, connection: ServerConnection) -> None:
        """Send a client its rows, until it or the session ends."""
        from websockets.exceptions import ConnectionClosed

        client = _Client()
        self._clients[client] = connection
        self.num_clients += 1
        try:
            with contextlib.suppress(ConnectionClosed):
                while (messages := await client.next()) is not None:
                    for message in messages:
                        await connection.send(message)
        finally:
            del self._clients[client]

    async def _end(self) -> None:
        for client in self._clients:
            client.put(None)
        ends_s = self._loop.time() + _LAST_ROWS_S
        while self._clients and self._loop.time() < ends_s:
            await asyncio.sleep(0.01)
        # A client that does not read would not take part in an orderly end either.
        for connection in self._clients.values():
            connection.transport.abort()
        self._server.close()
        await self._server.wait_closed()

    def _end_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not 0 < (whole_number(port) or 0) < 65536:
        raise SettingsError(
            "--websocket", expected="PORT or HOST:PORT, such as 9000 or 0.0.0.0:9000", found=address
        )
    return host.removeprefix("[").removesuffix("]") or "127.0.0.1", int(port)


def _silent_logger() -> logging.Logger:
    """A logger for the package, which else shows a traceback for everyone who connects and is no WebSocket client."""
    silent = logging.getLogger(f"{__name__}.server")
    silent.propagate = False
    silent.addHandler(logging.NullHandler())
    return silent
