"""What the readers of rig files are given, and what they return."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import InputError
from psotrack.geometry import Camera

#: Lengths of units by the names that files and options use, metres.
UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


@dataclass(frozen=True)
class Source:
    """A rig file as a reader gets it.

    Attributes:
        path: path of the file.
        text: content of the file.
        image_size_wh: width and height in pixels for cameras whose size the file does not state, or None.
    """

    path: Path
    text: str
    image_size_wh: tuple[int, int] | None = None

    def missing_size(self, place: str = "") -> InputError:
        """Error for a camera whose image size neither the file nor the user states."""
        where = f"{self.path}, {place}" if place else self.path
        return InputError(
            where,
            expected="the size of the images",
            found="a layout without image sizes",
            remedy="pass --size",
        )


@dataclass(frozen=True)
class Entry:
    """One camera of a rig file.

    Attributes:
        camera: the camera, with its translation in the file's unit of length; None if the file has no lens for it.
        placed: whether the file has the camera's pose; if not, the camera stands at the world's origin.
    """

    camera: Camera | None
    placed: bool = True


@dataclass(frozen=True)
class FileRig:
    """The cameras of a rig file.

    Attributes:
        entries: cameras by name, in the file's order.
        metres_per_unit: unit of length that the format or the file states, metres; None if both leave it open.
    """

    entries: Mapping[str, Entry]
    metres_per_unit: float | None


def collect(path: Path, entries: Iterable[tuple[str, str, Entry]]) -> dict[str, Entry]:
    """Cameras by name.

    Args:
        path: path of the file.
        entries: name of each camera, place of the name in the file, and the camera.

    Raises:
        InputError: a name occurs twice.
    """
    found: dict[str, Entry] = {}
    for name, place, entry in entries:
        if name in found:
            raise InputError(f"{path}, {place}", expected="each camera once", found=f"{name} again")
        found[name] = entry
    return found
