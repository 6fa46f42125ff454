"""Addresses of cameras, and why nothing comes from them: OpenCV says only that it cannot open them."""

from __future__ import annotations

import os
import re
import socket
import sys
from urllib.parse import urlsplit

#: How long a stream may take to answer and to bring a frame, seconds.
ANSWER_S = 5.0
_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "rtmp": 1935}
#: How the recording's addresses name devices.
_DEVICE = "device "


def device_of(address: str) -> int | str | None:
    """Number or path of a device; None for an address of a stream."""
    if not address.startswith(_DEVICE):
        return None
    device = address.removeprefix(_DEVICE)
    return int(device) if device.isdecimal() else device


def shown_address(address: str) -> str:
    """The address without its password, which does not belong into logs."""
    return re.sub(r"(://[^/@:]*):[^/@]*@", r"\1:***@", address)


def why_silent(address: str, took_s: float) -> str:
    """Why a camera could not be opened, as the end of a sentence after "found".

    Args:
        address: address of a stream, or a device.
        took_s: time after which OpenCV gave up, seconds.
    """
    device = device_of(address)
    if device is not None:
        return _why_no_device(f"/dev/video{device}" if isinstance(device, int) else device)
    if took_s >= ANSWER_S:
        return f"that it does not answer within {ANSWER_S:g} s"
    parts = urlsplit(address)
    port = parts.port or _PORTS.get(parts.scheme)
    if parts.hostname is None or port is None:
        return "that it does not answer"
    try:
        socket.create_connection((parts.hostname, port), ANSWER_S).close()
    except OSError as error:
        return f"that it does not answer: {error.strerror or error}".lower()
    return "no video there; are path, user name and password right?"


def _why_no_device(path: str) -> str:
    if sys.platform != "linux":
        return "no such camera, no permission for it, or another program that uses it"
    try:
        os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
    except FileNotFoundError:
        return f"no {path}; is the camera plugged in?"
    except PermissionError:
        return f"no permission for {path}; is this user in the group that owns it, mostly `video`?"
    except OSError as error:
        return f"{error.strerror} ({path})"
    return f"no camera at {path}, or another program that uses it"
