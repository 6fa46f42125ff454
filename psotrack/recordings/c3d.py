"""C3D files of motion capture: positions of markers over time.

C3D is the format of https://www.c3d.org, read and written by ezc3d (Michaud & Begon 2021). In a C3D file a marker that
was not seen has a residual of -1; in the DPJAIT recordings its coordinates are exactly zero. Here its position is NaN.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.support import atomic_write, short_repr

_METRES_PER_UNIT = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "m": 1.0, "in": 0.0254, "ft": 0.3048}
_BLOCK_BYTES = 512
#: Code of Intel processors in the header of the parameters.
_INTEL = 84
#: Largest number of frames that the header's 16 bits can hold.
_MAX_FRAMES = 2**16 - 1


@dataclass(frozen=True, repr=False)
class Markers:
    """Marker positions over the frames of a motion-capture recording.

    Attributes:
        labels: one label per marker; `Dron4:Dron41` is a marker of the body `Dron4`, `*12` is an unidentified marker.
        position_m: (frames, markers, 3), positions in the world, metres; NaN if the marker was not seen.
        rate_hz: frames per second.
    """

    labels: tuple[str, ...]
    position_m: Float[np.ndarray, "frames markers 3"]
    rate_hz: float

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.position_m.shape[1:] != (len(self.labels), 3):
            raise SettingsError(
                "markers",
                expected=f"positions of shape (frames, {len(self.labels)}, 3)",
                found=f"{self.position_m.shape}",
            )


def read_c3d(path: Path | str) -> Markers:
    """Read the markers of a C3D file, in metres.

    Raises:
        InputError: the file cannot be read, is cut short, has no markers, or its length unit is unknown.
    """
    path = Path(path)
    try:
        content = ezc3d.c3d(str(path))
        promised = _promised_frames(path)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        found = f"one that ezc3d cannot read ({error})" if path.exists() else "no such file"
        raise InputError(path, expected="a C3D file", found=found) from error
    parameters = content["parameters"]["POINT"]
    points = content["data"]["points"][:3].transpose(2, 1, 0)
    labels = _labels(parameters)[: points.shape[1]]
    if not labels or not len(points):
        raise InputError(path, expected="markers over time", found=f"{len(labels)} in {len(points)} frames")
    if len(points) < promised:
        raise InputError(
            path,
            expected=f"{promised} frames as its header says",
            found=f"{len(points)}",
            remedy="the file is cut short: copy it again",
        )
    unit = "".join(parameters["UNITS"]["value"][:1]).strip()
    if unit.lower() not in _METRES_PER_UNIT:
        raise InputError(path, expected=f"a unit of {', '.join(_METRES_PER_UNIT)}", found=repr(unit))
    rate_hz = float(parameters["RATE"]["value"][0])
    if not 0 < rate_hz < np.inf:
        raise InputError(path, expected="a rate above 0 Hz", found=f"{rate_hz:g}")
    residuals = content["data"]["meta_points"]["residuals"][0].T
    seen = (residuals >= 0) & np.isfinite(points).all(axis=-1) & (points != 0).any(axis=-1)
    position_m = np.where(seen[..., None], points * _METRES_PER_UNIT[unit.lower()], np.nan)
    return Markers(labels, position_m, rate_hz)


def write_c3d(path: Path | str, markers: Markers) -> None:
    """Write markers in millimetres as float32, which is exact to 1 micrometre in a hall; unseen markers become zeros.

    Raises:
        SettingsError: there are more frames than a C3D header can hold.
        OutputError: the file cannot be written.
    """
    num_frames, num_markers, _ = markers.position_m.shape
    if num_frames > _MAX_FRAMES:
        raise SettingsError(
            "markers", expected=f"at most {_MAX_FRAMES} frames in a C3D file", found=f"{num_frames}"
        )
    content = ezc3d.c3d()
    parameters = content["parameters"]["POINT"]
    parameters["UNITS"]["value"] = ["mm"]
    parameters["RATE"]["value"] = [markers.rate_hz]
    parameters["LABELS"]["value"] = list(markers.labels)
    points = np.ones((4, num_markers, num_frames))
    points[:3] = np.nan_to_num(markers.position_m / _METRES_PER_UNIT["mm"]).transpose(2, 1, 0)
    content["data"]["points"] = points
    with atomic_write(path) as temporary:
        content.write(str(temporary))
        # ezc3d reports no error when the disk is full.
        expected_bytes = num_frames * num_markers * 4 * 4
        if not temporary.is_file() or temporary.stat().st_size < expected_bytes:
            raise OutputError(path, expected="a path that can be written", found="an incomplete file")


def _labels(parameters: Mapping[str, Any]) -> tuple[str, ...]:
    """Labels of all markers: one parameter holds 255 labels, the next labels are in LABELS2 and so on."""
    names = ["LABELS", *(f"LABELS{number}" for number in range(2, 257))]
    return tuple(label for name in names if name in parameters for label in parameters[name]["value"])


def _promised_frames(path: Path) -> int:
    """Number of frames according to the header; ezc3d reads a shorter file without an error.

    0 for files of processors other than Intel's, whose header is not read here.
    """
    with path.open("rb") as file:
        header = file.read(_BLOCK_BYTES)
        parameter_block, first, last = struct.unpack("<B5xHH", header[:10])
        file.seek((parameter_block - 1) * _BLOCK_BYTES + 3)
        return last - first + 1 if file.read(1) == bytes([_INTEL]) else 0
