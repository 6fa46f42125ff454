"""Rows as messages: one line of JSON per drone and instant, on a stream of text or by UDP."""

from __future__ import annotations

import json
import logging
import socket
from typing import TextIO

from psotrack.errors import OutputError, SettingsError
from psotrack.support import whole_number
from psotrack.trajectories import Status, Trajectories

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
