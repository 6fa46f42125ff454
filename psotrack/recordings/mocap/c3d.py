"""C3D files of motion capture: positions of markers over time.

C3D is the format of https://www.c3d.org (`c3d_format` has its byte layout); files are written by ezc3d (Michaud &
Begon 2021). In a C3D file a marker that was not seen has a residual below 0; in the DPJAIT recordings its coordinates
are exactly zero. Here its position is NaN.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import ezc3d
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, OutputError, SettingsError, system_errors
from psotrack.recordings.mocap.c3d_format import BLOCK_BYTES, Header, Parameters, Processor, read_layout
from psotrack.recordings.timing import check_rate
from psotrack.support import atomic_write, check_kind, short_repr

_logger = logging.getLogger(__name__)
_METRES_PER_UNIT = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "m": 1.0, "in": 0.0254, "ft": 0.3048}
#: Words for units; a parameter that holds few characters cuts them, so that `mete` is the metre.
_WORDS = {
    "micrometers": "um", "millimeters": "mm", "centimeters": "cm", "decimeters": "dm", "meters": "m",
    "micrometres": "um", "millimetres": "mm", "centimetres": "cm", "decimetres": "dm", "metres": "m",
    "microns": "um", "inches": "in", "foot": "ft", "feet": "ft",
}  # fmt: skip
#: Smallest number of characters that tell one word from another one.
_WORD_START = 3
#: Largest number of frames that 16 bits can hold; a larger number is written elsewhere, and here this number.
_MAX_FRAMES = 2**16 - 1
#: Farthest position of a marker: a larger one is from damaged bytes.
_FARTHEST_M = 1e5


@dataclass(frozen=True, repr=False)
class Markers:
    """Marker positions over the frames of a motion-capture recording.

    Attributes:
        labels: one label per marker; `Dron4:Dron41` is a marker of the body `Dron4`, `*12` is an unidentified marker.
        position_m: (frames, markers, 3), positions in the world, metres; NaN if the marker was not seen.
        rate_hz: frames per second.
        first_frame: number of the first frame, from 0 on; above 0 where the recording's first frames were cut off.
    """

    labels: tuple[str, ...]
    position_m: Float[np.ndarray, "frames markers 3"]
    rate_hz: float
    first_frame: int = 0

    __repr__ = short_repr

    @property
    def frame(self) -> Int[np.ndarray, "frames"]:
        """(frames,), numbers of the frames."""
        return self.first_frame + np.arange(len(self.position_m))

    def __post_init__(self) -> None:
        if self.position_m.shape[1:] != (len(self.labels), 3):
            raise SettingsError(
                "markers",
                expected=f"positions of shape (frames, {len(self.labels)}, 3)",
                found=f"{self.position_m.shape}",
            )


def read_c3d(path: Path | str) -> Markers:
    """Read the markers of a C3D file of any maker, in metres.

    The parameters of the file count, not its header: some makers leave the header at what it was before the recording
    was cut. Where there are no parameters, the header counts, and markers have no labels. A warning says that a length
    unit is not stated and taken for the millimetre, that a file has fewer frames than it promises, and at what time it
    begins where its first frames were cut off.

    Raises:
        InputError: the file cannot be read, is cut short before its first frame, has no markers, has a position far
            away from everything that motion capture can see, or its length unit is unknown.
    """
    path = Path(path)
    check_kind(path, "a C3D file")
    with system_errors(path, "a C3D file"):
        content = path.read_bytes()
    try:
        processor, header, parameters = read_layout(content)
    except ValueError as error:
        raise InputError(path, expected="a C3D file", found=str(error)) from error
    data = _find_points(path, content, processor, header, parameters)
    position, seen = data.read(content)
    position_m = np.where(seen[..., None], position * _metres_per_unit(path, parameters), np.nan)
    with np.errstate(invalid="ignore"):
        far = np.argwhere((np.abs(position_m) > _FARTHEST_M).any(axis=-1))
    if len(far):
        frame, marker = far[0].tolist()
        found = f"{np.abs(position_m[frame, marker]).max():.3g} m for marker {marker + 1} in frame {frame}"
        raise InputError(path, expected=f"positions of at most {_FARTHEST_M:g} m", found=found)
    rate_hz = parameters.number("POINT:RATE") or header.rate_hz
    check_rate(path, rate_hz)
    first = _long_number(parameters, "TRIAL:ACTUAL_START_FIELD") or header.first_frame
    if first > 1:
        begin_s = (first - 1) / rate_hz
        _logger.warning(
            "%s: its first frame has the number %d, and so the time %.3f s; if the videos begin with it, say "
            "[reference] time_offset_s = %.3f", path, first, begin_s, -begin_s,
        )  # fmt: skip
    return Markers(_labels(parameters, data.num_points), position_m, rate_hz, max(first - 1, 0))


def write_c3d(path: Path | str, markers: Markers) -> None:
    """Write markers in millimetres as float32, which is exact to 1 micrometre in a hall.

    Unseen markers become zeros with a residual of -1, as the format demands. A marker exactly at the origin is
    read back as unseen.

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
    seen = np.isfinite(markers.position_m).all(axis=-1)
    content["data"]["meta_points"]["residuals"] = np.where(seen, 0.0, -1.0).T[None]
    with atomic_write(path) as temporary:
        content.write(str(temporary))
        # ezc3d reports no error when the disk is full.
        if not _is_complete(temporary, markers):
            raise OutputError(path, expected="a path that can be written", found="an incomplete file")


def _is_complete(path: Path, markers: Markers) -> bool:
    try:
        written = read_c3d(path)
    except InputError:
        return False
    return written.position_m.shape == markers.position_m.shape


@dataclass(frozen=True)
class _Points:
    """Where the points of a file lie.

    Attributes:
        processor: byte order of the numbers.
        scale: length units per unit of an integer coordinate; below 0 if coordinates are reals.
        start: first byte of the first frame.
        num_points: points per frame, which come first in a frame.
        num_analog: analogue samples per frame.
        num_frames: frames to read.
    """

    processor: Processor
    scale: float
    start: int
    num_points: int
    num_analog: int
    num_frames: int = 0

    @property
    def word_bytes(self) -> int:
        return 4 if self.scale < 0 else 2

    @property
    def frame_bytes(self) -> int:
        return (4 * self.num_points + self.num_analog) * self.word_bytes

    def available(self, content: bytes) -> int:
        """Number of whole frames that the file holds, as far as its last block."""
        return max(0, len(content) - self.start) // self.frame_bytes

    def read(
        self, content: bytes
    ) -> tuple[Float[np.ndarray, "frames points 3"], Bool[np.ndarray, "frames points"]]:
        """Positions in the file's length unit, and whether they were seen."""
        frames = np.frombuffer(content, np.uint8, self.num_frames * self.frame_bytes, self.start)
        points = frames.reshape(self.num_frames, -1)[:, : 4 * self.num_points * self.word_bytes].tobytes()
        if self.scale < 0:
            values = self.processor.reals(points)
        else:
            values = np.frombuffer(points, f"{self.processor.order}i2").astype(float)
        values = values.reshape(self.num_frames, self.num_points, 4)
        position = values[..., :3] * (1.0 if self.scale < 0 else self.scale)
        # The fourth word holds the residual and the cameras; a value below 0, or none, is that of an unseen point.
        seen = (values[..., 3] >= 0) & np.isfinite(position).all(axis=-1) & (position != 0).any(axis=-1)
        return position, seen


def _find_points(
    path: Path, content: bytes, processor: Processor, header: Header, parameters: Parameters
) -> _Points:
    """The layout of the points, by what the parameters say, what the header says, and what the file holds."""
    used = parameters.count("POINT:USED")
    if parameters.values and not any(name.startswith("POINT:") for name in parameters.values):
        raise InputError(
            path, expected="a C3D file with parameters of its points, POINT:LABELS and the like", found="none"
        )
    if not (header.num_points if used is None else used):
        num_analog = header.num_analog
        found = f"none, only {num_analog} analogue samples per frame" if num_analog else "none"
        raise InputError(path, expected="markers over time", found=found)
    scale = _scale(path, header, parameters)
    block = header.data_block or parameters.count("POINT:DATA_START") or 0
    start = (block - 1) * BLOCK_BYTES
    if start < BLOCK_BYTES:
        raise InputError(path, expected="a C3D file", found="none that says where its frames begin")
    layouts = [
        _Points(processor, scale, start, num_points, num_analog)
        for num_points in dict.fromkeys(each for each in (used, header.num_points) if each)
        for num_analog in dict.fromkeys(_analog_counts(header, parameters))
    ]
    stated = _stated_frames(parameters)
    enough = header.num_frames if stated is None else stated
    layout = next((each for each in layouts if each.available(content) >= enough), layouts[0])
    count = _count_frames(path, header, stated, layout.available(content), layout.frame_bytes)
    return _Points(processor, scale, start, layout.num_points, layout.num_analog, count)


def _scale(path: Path, header: Header, parameters: Parameters) -> float:
    stated = parameters.number("POINT:SCALE")
    scale = stated or header.scale
    if not np.isfinite(scale) or scale == 0:
        raise InputError(path, expected="a scale of the coordinates", found=f"{scale:g}")
    if header.scale and (
        (scale < 0) != (header.scale < 0) or (scale > 0 and not np.isclose(scale, header.scale, rtol=1e-4))
    ):
        raise InputError(
            path,
            expected="one scale of the coordinates",
            found=f"{header.scale:g} in its header and {scale:g} in POINT:SCALE",
        )
    return scale


def _analog_counts(header: Header, parameters: Parameters) -> Iterator[int]:
    """Analogue samples per frame, which some makers write as the number of channels, the likelier number first."""
    used = parameters.count("ANALOG:USED")
    if used is not None:
        yield used * header.samples_per_frame
    yield header.num_analog
    yield header.num_analog * header.samples_per_frame


def _stated_frames(parameters: Parameters) -> int | None:
    """Number of frames that the parameters state; None if they state none, or more than their 16 bits hold."""
    count = parameters.count("POINT:FRAMES")
    if count and count != _MAX_FRAMES:
        return count
    long = parameters.count("POINT:LONG_FRAMES")
    if long:
        return long
    begin, end = (_long_number(parameters, f"TRIAL:ACTUAL_{edge}_FIELD") for edge in ("START", "END"))
    return None if not end else end - max(begin or 1, 1) + 1


def _long_number(parameters: Parameters, name: str) -> int | None:
    """A number of two 16-bit words, the lower word first."""
    words = parameters.values.get(name)
    if words is None or isinstance(words, list) or not words.size:
        return None
    low, high = (int(word) % 2**16 for word in [*words.flat, 0][:2])
    return low + high * 2**16


def _count_frames(path: Path, header: Header, stated: int | None, available: int, frame_bytes: int) -> int:
    """Number of frames to read: what the parameters state where it is there, else what the header states, or all.

    Raises:
        InputError: no whole frame is there.
    """
    if not available:
        raise InputError(
            path, expected="markers over time", found="no whole frame", remedy="is the file cut short?"
        )
    if stated is None:
        # The last block is filled up, with room for frames that are none.
        filled = available * frame_bytes - header.num_frames * frame_bytes < BLOCK_BYTES
        overflown = header.num_frames >= _MAX_FRAMES - 1 and not filled
        stated = header.num_frames if header.num_frames and not overflown else available
    count = stated
    if available < stated:
        count = header.num_frames if 0 < header.num_frames <= available else available
    # The header's 16 bits cannot count more frames.
    if count < stated or (header.num_frames != stated and stated < _MAX_FRAMES):
        _logger.warning(
            "%s: its header says %d frames and its parameters say %d; it holds %d, of which %d are read%s",
            path, header.num_frames, stated, available, count, "; was it cut short?" * (count < stated),
        )  # fmt: skip
    return count


def _metres_per_unit(path: Path, parameters: Parameters) -> float:
    unit = "".join(parameters.texts("POINT:UNITS")[:1])
    if not unit:
        _logger.warning("%s: it has no POINT:UNITS; its coordinates are read as millimetres", path)
        unit = "mm"
    written, unit = unit, unit.lower()
    if unit not in _METRES_PER_UNIT and len(unit) >= _WORD_START:
        meant = {_WORDS[word] for word in _WORDS if word.startswith(unit) or word == f"{unit}s"}
        unit = meant.pop() if len(meant) == 1 else unit
    if unit not in _METRES_PER_UNIT:
        raise InputError(path, expected=f"a unit of {', '.join(_METRES_PER_UNIT)}", found=repr(written))
    return _METRES_PER_UNIT[unit]


def _labels(parameters: Parameters, num_points: int) -> tuple[str, ...]:
    """Labels of all markers: one parameter holds 255 labels, the next labels are in LABELS2 and so on.

    A marker without label gets the label of an unidentified marker.
    """
    names = ["POINT:LABELS", *(f"POINT:LABELS{number}" for number in range(2, 257))]
    labels = [label for name in names for label in parameters.texts(name)][:num_points]
    labels += [""] * (num_points - len(labels))
    return tuple(label or f"*{number}" for number, label in enumerate(labels, 1))
