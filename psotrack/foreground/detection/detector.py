"""Detection of drones by a neural network: a YOLO model in ONNX format, run by OpenCV on every frame of a video.

Frames are scaled into the network's square input with grey borders (letterbox), RGB in [0, 1]. Shape and content of the
output identify its layout:

- "v5", of v5 to v7: (1, boxes, 5 + classes): middle and size, confidence of any object, confidence of each class;
- "v8", of v8, v9 and v11: (1, 4 + classes, boxes), or turned: middle and size, confidence of each class;
- "corners", of v10 and of networks with a suppression of their own: (1, boxes, 6): corners, and the confidence and the
  number of the class in either order; rows without a box are 0;
- "middles": the same with middle and size instead of corners, which only the settings can say;
- "yolox", as its authors export it: as v5, but middles in cells from a cell's own corner and logarithms of sizes in
  cells, of the cells of three grids one after another; the input is BGR in [0, 255], which only the settings can say.

Boxes are in pixels of the input, or in shares of its side. Objects of all classes count as drones: use a network that
was trained on drones.
"""

from __future__ import annotations

import contextlib
import functools
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.detection.settings import DetectorSettings, Layout
from psotrack.foreground.network.names import MODEL_SUFFIX, NETWORK, model_path
from psotrack.recordings import (
    Detections,
    Recording,
    VideoInfo,
    digest_video,
    read_frames,
    silence_opencv,
    write_detections,
)
from psotrack.support import (
    Report,
    check_file_name,
    digest_file,
    digest_record,
    identify,
    make_plugin,
    no_progress,
)

#: Boxes (found, 4) and confidences (found,), as `Detector` describes them.
FoundBoxes = tuple[Float[np.ndarray, "found 4"], Float[np.ndarray, "found"]]

#: Colour of YOLO's own letterbox borders.
_GREY = (114, 114, 114)
#: Largest excess of a score over 1 that is ignored as rounding.
_ROUNDING = 1e-3
#: Coordinates up to this number are shares of the input's side: nothing that is found is within two pixels of a corner.
_LARGEST_SHARE = 2.0
#: Widths of the cells of YOLOX's grids, pixels of the input.
_CELLS_PX = (8, 16, 32)
_SAY_LAYOUT = "say which with --layout (--detector-layout of track)"


@runtime_checkable
class Detector(Protocol):
    """Finds drones in images.

    The detector works on NumPy arrays, outside of any compiled function, in the calling process, one frame at a time.

    Attributes:
        key: everything on which the detections depend, as plain data fit for JSON. Detections are stored under the
            class's name and this key; with an equal key, stored detections are used again.
    """

    @property
    def key(self) -> Mapping[str, Any]: ...  # noqa: D102

    def boxes(self, bgr: UInt8[np.ndarray, "height width 3"]) -> FoundBoxes:
        """Find the drones in an image.

        Args:
            bgr: (height, width, 3) uint8, the frame of one camera, blue first.

        Returns:
            Boxes (found, 4), xyxy in pixels of the frame: x0, y0, x1, y1 with 0 <= x0 < x1 <= width, edges as in
            `psotrack.geometry.boxes`, where pixel 0 reaches from 0 to 1; and confidences (found,) in [0, 1].
        """
        ...


@runtime_checkable
class LearnsVideo(Protocol):
    """A detector that looks at a video before it finds drones in the video's frames."""

    def of_video(self, video: VideoInfo) -> Detector:
        """The detector for the frames of one video."""
        ...


class OnnxDetector:
    """A network that finds drones in images.

    Args:
        model: path of an ONNX file.
        settings: settings of the detection.

    Raises:
        InputError: the file does not exist, or OpenCV cannot read it, or would end the process.
    """

    def __init__(self, model: Path | str, settings: DetectorSettings) -> None:
        self.model = model = Path(model)
        self.settings = settings
        _check_own_numbers(model)
        _check_survives(model, settings.size, model.stat().st_mtime_ns)
        with self._opencv_errors("an ONNX model that OpenCV can read"):
            self._network = cv2.dnn.readNetFromONNX(str(model))

    @property
    def key(self) -> Mapping[str, Any]:
        """See `Detector`."""
        return {"model": digest_file(self.model), "settings": msgspec.to_builtins(self.settings)}

    def boxes(self, bgr: UInt8[np.ndarray, "height width 3"]) -> FoundBoxes:
        """Detect drones in an image.

        Args:
            bgr: (height, width, 3), the image.

        Returns:
            Boxes (found, 4), xyxy in the convention of `psotrack.geometry.boxes`, and confidences (found,), the highest
            confidence first.

        Raises:
            InputError: the network cannot take an input of this size, or its output has an unknown layout.
        """
        size = self.settings.size
        image, scale, start = _letterboxed(bgr, size)
        with self._opencv_errors(f"a network for images of {size} x {size} pixels", "pass its own --size"):
            is_yolox = self.settings.layout == "yolox"
            scale_of_grey = 1.0 if is_yolox else 1 / 255
            self._network.setInput(cv2.dnn.blobFromImage(image, scale_of_grey, swapRB=not is_yolox))
            output = self._network.forward()
        in_square, score = self._decode(np.asarray(output, np.float64))
        if np.abs(in_square[score >= self.settings.confidence]).max(initial=0.0) <= _LARGEST_SHARE:
            in_square *= size
        xyxy = (in_square - np.tile(start, 2)) / np.tile(scale, 2)
        return usable_boxes(xyxy, np.minimum(score, 1.0), bgr.shape, self.settings)

    def _decode(self, output: Float[np.ndarray, "..."]) -> FoundBoxes:
        """Boxes (xyxy in pixels of the input, or in shares of its side) and their scores from the network's output."""
        table = output[0] if output.ndim == 3 and len(output) == 1 else np.empty((0, 0))
        layout = self.settings.layout or self._layout_of(table)
        if layout == "v8" and len(table) < table.shape[1]:
            table = table.T
        columns = table.shape[1]
        has_objectness = layout in ("v5", "yolox")
        if layout is None or columns < 5 or (has_objectness and columns < 6):
            expected = f"an output in the layout {layout}" if layout else "an output in a layout of YOLO"
            raise InputError(self.model, expected=expected, found=f"{output.shape}")
        if layout in ("corners", "middles"):
            # The numbers of classes are whole, their confidences are not.
            order = 5 if _are_whole(table[:, 4]) and not _are_whole(table[:, 5]) else 4
            scores = table[:, [order]]
        else:
            scores = table[:, 4:]
        in_range = np.all((scores >= 0) & (scores <= 1 + _ROUNDING), axis=0)
        if not (np.isfinite(table).all() and in_range.all()):
            found = f"scores from {scores.min():.3g} to {scores.max():.3g}"
            remedy = "export the network with its last layers, in YOLO's own layout"
            if in_range[:-1].all() and np.abs(scores[:, -1]).max() <= np.pi:
                found, remedy = (
                    f"{found}, as of oriented boxes with their angle",
                    "use a network of upright boxes",
                )
            expected = "finite boxes with scores from 0 to 1"
            raise InputError(self.model, expected=expected, found=found, remedy=remedy)
        score = scores[:, 1:].max(axis=1) * scores[:, 0] if has_objectness else scores.max(axis=1)
        if layout == "corners":
            return table[:, :4], score
        middle, half = table[:, :2], table[:, 2:4] / 2
        if layout == "yolox":
            corner, width = self._cells(len(table))
            middle, half = (middle + corner) * width, np.exp(table[:, 2:4]) * width / 2
        elif layout == "v5" and (half < 0).any():
            expected, found = "boxes with sizes above 0", f"{2 * half.min():.3g}, as of YOLOX"
            raise InputError(self.model, expected=expected, found=found, remedy=_SAY_LAYOUT)
        return np.hstack([middle - half, middle + half]), score

    def _cells(self, count: int) -> tuple[Float[np.ndarray, "cells 2"], Float[np.ndarray, "cells 1"]]:
        """Corner x, y, in cells, and width, in pixels, of each cell of YOLOX's grids."""
        sides = [self.settings.size // width for width in _CELLS_PX]
        corner = np.concatenate([np.indices((side, side))[::-1].reshape(2, -1).T for side in sides])
        width = np.repeat(_CELLS_PX, np.square(sides))[:, None]
        if len(corner) != count:
            found, expected = f"{count} boxes", f"{len(corner)}, one of each cell of YOLOX's grids"
            raise InputError(self.model, expected=expected, found=found, remedy="pass its own --size")
        return corner.astype(float), width.astype(float)

    def _layout_of(self, table: Float[np.ndarray, "rows columns"]) -> Layout | None:
        """The layout of an output, None for none that is known.

        Raises:
            InputError: the output may have more than one layout.
        """
        rows, columns = table.shape
        if columns == 6 and (_are_whole(table[:, 4]) or _are_whole(table[:, 5])):
            if (table[:, 2:4] >= table[:, :2]).all():
                return "corners"
            # The only class of v5 may have the confidence 1 everywhere.
            if len(np.unique(table[:, 5])) > 1:
                expected = "boxes whose layout their numbers show"
                found = "whole numbers of classes, but no corners"
                raise InputError(self.model, expected=expected, found=found, remedy=_SAY_LAYOUT)
        if rows > columns:
            return "v5" if columns > 5 else "v8" if columns == 5 else None
        return "v8" if columns > rows > 4 else None

    @contextlib.contextmanager
    def _opencv_errors(self, expected: str, remedy: str = "") -> Iterator[None]:
        """Turn OpenCV's errors in this block into `InputError`, and suppress OpenCV's own messages."""
        try:
            with silence_opencv():
                yield
        except cv2.error as error:
            found = f"one that it cannot use ({' '.join((error.err or str(error)).split())})"
            raise InputError(self.model, expected=expected, found=found, remedy=remedy) from error


def _are_whole(numbers: Float[np.ndarray, "rows"]) -> bool:
    return bool((numbers == np.round(numbers)).all())


#: Memory, bytes, and time, seconds, that a network may take for one image.
_MOST_BYTES, _MOST_S = 8 << 30, 120.0
#: Reads a network and runs it on a black image. Errors of OpenCV are no concern here.
_RUN_ONCE = """
import contextlib, sys, cv2, numpy
with contextlib.suppress(ImportError):  # Windows
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[3]),) * 2)
side = int(sys.argv[2])
network = cv2.dnn.readNetFromONNX(sys.argv[1])
network.setInput(cv2.dnn.blobFromImage(numpy.zeros((side, side, 3), numpy.uint8)))
network.forward()
"""


#: What names a file in an ONNX model: the key of the file's name, with its length before it. Protobuf reads a length
#: also with superfluous zeros.
_OTHER_FILE = re.compile(rb"(\x08|\x88\x80*\x00)location")


def _check_own_numbers(model: Path) -> None:
    """Raise `InputError` for a network that cannot be read, or has numbers in other files.

    OpenCV reads any file of the machine that a network names; and a digest of the network says nothing about them.
    """
    try:
        content = model.read_bytes()
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(model, expected="an ONNX model", found=found) from error
    if _OTHER_FILE.search(content):
        expected = "a network with all its numbers in one file, exported without external data"
        raise InputError(model, expected=expected, found="tensors in other files")


@functools.lru_cache(maxsize=16)
def _check_survives(model: Path, size: int, _modified_ns: int) -> None:
    """Raise `InputError` if a network ends the process that runs it, as OpenCV does for some damaged files."""
    command = [sys.executable, "-c", _RUN_ONCE, str(model.resolve()), str(size), str(_MOST_BYTES)]
    try:
        code = subprocess.run(command, capture_output=True, check=False, timeout=_MOST_S).returncode
        found = f"one that ends the process that runs it (exit code {code})"
    except subprocess.TimeoutExpired:
        code, found = None, f"one that takes more than {_MOST_S:g} s for an image"
    # An error of Python has the exit code 1; OpenCV's errors are met again in this process.
    if code not in (0, 1):
        raise InputError(model, expected="an ONNX model that OpenCV can run", found=found)


def find_detector(name: str, settings: DetectorSettings) -> Detector:
    """The detector that `--detector` names: "network", a file of `psotrack train`, an ONNX file, or a plugin.

    Args:
        name: the network that comes with the package, the path of such a file, or name of a plugin.
        settings: settings of the detection.

    Raises:
        InputError: the file does not exist, or OpenCV cannot read it.
        SettingsError: there is neither such a file nor such a plugin.
    """
    if path := model_path(name):
        from psotrack.foreground.detection.network_detector import NetworkDetector

        return NetworkDetector(path, settings)
    if Path(name).suffix.lower() == ".onnx" or Path(name).exists():
        return OnnxDetector(name, settings)
    built_in = [NETWORK, "MODEL.onnx (a file)", f"DRONES{MODEL_SUFFIX} (a file of `psotrack train`)"]
    return make_plugin("detector", name, settings, interface=Detector, setting="detector", built_in=built_in)


def usable_boxes(
    xyxy: Float[np.ndarray, "boxes 4"],
    score: Float[np.ndarray, "boxes"],
    shape: tuple[int, ...],
    settings: DetectorSettings,
) -> FoundBoxes:
    """Boxes within an image, and their scores, the highest first; of boxes of one drone only the best.

    Args:
        xyxy: boxes in pixels of the image.
        score: their scores.
        shape: height and width of the image, pixels.
        settings: settings of the detection; `confidence` and `nms` are used.
    """
    xyxy = np.clip(xyxy, 0, [shape[1], shape[0]] * 2)
    xywh = np.hstack([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]])
    found = (xywh[:, 2:] > 0).all(axis=1) & (score >= settings.confidence)
    xyxy, xywh, score = xyxy[found], xywh[found], score[found]
    # OpenCV sorts by score; for no boxes it returns an empty tuple.
    kept = cv2.dnn.NMSBoxes(xywh.tolist(), score.tolist(), settings.confidence, settings.nms)
    index = np.asarray(kept, np.int64).ravel()
    return xyxy[index], score[index]


def detect_drones(
    detector: Detector, name: str, video: VideoInfo, *, report: Report = no_progress
) -> Detections:
    """Detect drones in all frames of a video.

    Args:
        detector: the detector.
        name: name of the progress bar.
        video: the video.
        report: shows the progress in frames.

    Raises:
        InputError: the video ends early, or the network cannot be used.
        SettingsError: the detector yields arrays of other shapes than `Detector` says.
    """
    if isinstance(detector, LearnsVideo):
        detector = detector.of_video(video)
    tables = [np.empty((0, 6))]
    with report(name, video.num_frames) as advance:
        for number, bgr in enumerate(read_frames(video)):
            boxes, confidence = map(np.asarray, detector.boxes(bgr))
            if boxes.ndim != 2 or boxes.shape[1] != 4 or confidence.shape != boxes.shape[:1]:
                where = f"detector {type(detector).__name__}, frame {number}"
                expected = "boxes of shape (found, 4) and confidences of shape (found,)"
                raise SettingsError(where, expected=expected, found=f"{boxes.shape} and {confidence.shape}")
            tables.append(np.column_stack([np.full(len(boxes), number), boxes, confidence]))
            advance(1)
    table = np.concatenate(tables, dtype=np.float64)
    return Detections(table[:, 0].astype(np.int64), table[:, 1:5], table[:, 5])


def _letterboxed(
    bgr: UInt8[np.ndarray, "height width 3"], size: int
) -> tuple[UInt8[np.ndarray, "size size 3"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The image in the middle of a grey square, with the scale and the start that map x, y of the image to the square.

    A point p of the image is at p * scale + start in the square.
    """
    image_wh = np.array([bgr.shape[1], bgr.shape[0]])
    inside_wh = np.maximum(np.round(image_wh * size / image_wh.max()), 1).astype(int)
    start = (size - inside_wh) // 2
    left, top = start.tolist()
    right, bottom = (size - inside_wh - start).tolist()
    # The interpolation with which YOLO networks are trained.
    resized = cv2.resize(bgr, inside_wh.tolist(), interpolation=cv2.INTER_LINEAR)
    image = cv2.copyMakeBorder(resized, top, bottom, left, right, cv2.BORDER_CONSTANT, value=_GREY)
    return np.asarray(image, np.uint8), inside_wh / image_wh, start.astype(np.float64)


def stored_detections(
    detector: Detector, recording: Recording, *, cache: Path | str, report: Report = no_progress
) -> Path:
    """Detect drones in the videos of a sequence, unless the detections are stored already.

    The file of a video appears when it is complete. A call after an interruption continues with the first video without
    a file.

    Args:
        detector: the detector.
        recording: a consistent recording (see `Recording.usable`).
        cache: folder for stored results.
        report: shows the progress in frames.

    Returns:
        Folder with one file of detections per video.

    Raises:
        InputError: a video cannot be read, or the network cannot be used.
        SettingsError: the detector's key is no plain data, or it yields arrays of wrong shapes.
        OutputError: a file cannot be written.
    """
    videos = {name: [video.num_frames, digest_video(video)] for name, video in recording.videos.items()}
    folder = Path(cache) / "detections" / digest_record({"detector": identify(detector), "videos": videos})
    for name, video in recording.videos.items():
        path = folder / f"{check_file_name(name, recording.folder)}.csv"
        if not path.exists():
            write_detections(path, detect_drones(detector, name, video, report=report))
    return folder
