"""Rows as messages: one line of JSON per drone and instant, on a stream of text or by UDP."""

from __future__ import annotations

import json
import logging
import socket
from typing import Any, TextIO

from psotrack.errors import OutputError, SettingsError
from psotrack.support import whole_number
from psotrack.trajectories import Status, Trajectories

logger = logging.getLogger(__name__)


def lines_of(rows: Trajectories) -> list[str]:
    """One line of JSON for each drone: frame, time_s, drone, position_m, velocity_m_s, covariance_m2, status."""
    assert rows.velocity_m_s is not None
    assert rows.covariance_m2 is not None
    assert rows.status is not None
    lines = []
    for index, drone in enumerate(rows.drones):
        content: dict[str, Any] = {
            "frame": int(rows.frame[0]),
            "time_s": float(rows.time_s[0]),
            "drone": drone,
        }
        for name in ("position_m", "velocity_m_s", "covariance_m2"):
            content[name] = getattr(rows, name)[0, index].tolist()
        content["status"] = Status(int(rows.status[0, index])).label
        lines.append(json.dumps(content))
    return lines


def host_and_port(option: str, address: str, *, usual_host: str | None = None) -> tuple[str, int]:
    """Host and port of an address HOST:PORT.

    Args:
        option: the option that has the address, for messages.
        address: HOST:PORT, or PORT where there is a usual host.
        usual_host: the host of an address without one.

    Raises:
        SettingsError: the address is none.
    """
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or usual_host or ""
    if not host or not 0 < (whole_number(port) or 0) < 65536:
        expected = (
            "PORT or HOST:PORT, such as 9000 or 0.0.0.0:9000"
            if usual_host
            else "HOST:PORT, such as 127.0.0.1:9000"
        )
        raise SettingsError(option, expected=expected, found=address)
    return host, int(port)


class JsonLines:
    """Writes rows to a stream of text, such as stdout.

    Raises:
        OutputError: the stream takes no more, because the disk is full for instance.
        BrokenPipeError: the program that reads the stream has ended.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, rows: Trajectories) -> None:
        """Write the rows of an instant."""
        try:
            for line in lines_of(rows):
                self._stream.write(line + "\n")
            self._stream.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            found = f"{error.strerror or error}".lower()
            raise OutputError("--lines", expected="to write rows", found=found) from error


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
        self._address = address
        self._target = target
        self._said = ""
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
