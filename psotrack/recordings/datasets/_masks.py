"""`drone_masks.zip` of the DPJAIT dataset: silhouettes of drones, one binary image per camera, drone and frame.

The names in the published archives are unknown. The writer names images `cam1i/dron1/000000.png` and so on; they are
1-bit PNGs, white where the drone is seen, one for every frame, black images included. The reader accepts any archive
of images whose paths name a camera (`cam1i` or a serial number), a drone (`dron1`, `drone_1`) and a frame (the
last remaining number).
"""

from __future__ import annotations

import functools
import re
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Bool

from psotrack.errors import InputError
from psotrack.geometry import camera_key, chosen_camera
from psotrack.recordings import image_of
from psotrack.support import atomic_write

MASKS = "drone_masks.zip"
#: What `zipfile` raises for archives that are damaged, encrypted, or compressed in a way that it does not know.
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error, ValueError),
)

#: Largest size of an image that an archive states, bytes: more than those of a large camera. `zipfile` unpacks no more
#: than is stated.
_MOST_IMAGE = 1 << 26

Mask = Bool[np.ndarray, "height width"]

_EXPECTED = "images such as cam1i/dron1/000000.png (camera, drone, frame)"
_IMAGE_SUFFIXES = {".png", ".bmp", ".jpg", ".jpeg", ".tif", ".tiff", ".webp"}
_CAMERA = re.compile(r"cam[a-z]*_?(?:\d{6,}|\d+i?)|\d{6,}(?=[^\d].*/)", re.IGNORECASE)
_DRONE = re.compile(r"drone?_?(\d{1,9})(?!\d)", re.IGNORECASE)
_NUMBER = re.compile(r"(?<!\d)\d{1,9}(?!\d)")


class MaskWriter:
    """Writes masks into an archive.

    Args:
        path: path of the archive. The file exists from the start, incomplete, so that its folder should be a temporary
            one.

    Raises:
        OSError: the archive cannot be written.
    """

    def __init__(self, path: Path | str) -> None:
        self._archive = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED)

    def __enter__(self) -> MaskWriter:
        return self

    def write(self, camera: str, drone: int, frame: int, mask: Mask) -> None:
        """Append the mask of a drone in one frame of a camera.

        Args:
            camera: name of the camera.
            drone: number of the drone, from 1.
            frame: number of the frame, from 0.
            mask: (height, width), True where the drone is seen.
        """
        png = _png(mask) if mask.any() else _empty_png(*mask.shape)
        self._archive.writestr(_stored_entry(f"{camera}/dron{drone}/{frame:06d}.png"), png)

    def __exit__(self, *error: object) -> None:
        self._archive.close()


def join_archives(path: Path, parts: Sequence[Path]) -> None:
    """Join several archives into one archive, which appears at `path` when it is complete.

    Args:
        path: path of the new archive; archives with equal contents have equal bytes.
        parts: paths of archives of `MaskWriter`; no name occurs in two archives.

    Raises:
        InputError: a part is not a ZIP archive.
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w") as joined:
        for part in parts:
            with _opened(part, "a ZIP archive") as archive:
                for entry in archive.infolist():
                    joined.writestr(_stored_entry(entry.filename), archive.read(entry))


def _stored_entry(name: str) -> zipfile.ZipInfo:
    """An entry that is not compressed and has the first date of the format, so that equal contents are equal bytes."""
    entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    entry.external_attr = 0o644 << 16
    return entry


def _opened(path: Path, expected: str) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (OSError, *_ZIP_ERRORS) as error:
        found = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(path, expected=expected, found=found.lower()) from error


class Masks:
    """Masks in an archive, each decoded when it is requested; a context manager.

    Attributes:
        cameras: names of the cameras, without `_s`.
        drones: numbers of the drones, from 1.
        frames: numbers of the frames with masks.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._archive = path, _opened(path, "a ZIP archive of masks")
        self._names = _index_images(path, self._archive.namelist())
        cameras, drones, frames = (sorted(set(column)) for column in zip(*self._names, strict=True))
        self.cameras: tuple[str, ...] = tuple(cameras)
        self.drones: tuple[int, ...] = tuple(drones)
        self.frames: tuple[int, ...] = tuple(frames)

    def mask(self, camera: str, drone: int, frame: int) -> Mask:
        """(height, width), True where a drone is seen.

        Args:
            camera: name of the camera.
            drone: number of the drone, from 1.
            frame: number of the frame.

        Raises:
            InputError: the mask does not exist or is not an image.
        """
        key = chosen_camera(camera, self.cameras)
        name = None if key is None else self._names.get((key, drone, frame))
        if name is None:
            raise InputError(
                self._path, expected=f"a mask of dron{drone} in frame {frame} of {camera}", found="none"
            )
        if (size := self._archive.getinfo(name).file_size) > _MOST_IMAGE:
            expected = f"an image of at most {_MOST_IMAGE} bytes"
            raise InputError(f"{self._path}: {name}", expected=expected, found=f"{size} bytes")
        try:
            data = self._archive.read(name)
        except (OSError, *_ZIP_ERRORS) as error:
            found = str(error) or type(error).__name__
            raise InputError(f"{self._path}: {name}", expected="an image", found=found) from error
        return image_of(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE, f"{self._path}: {name}") > 0

    def __enter__(self) -> Masks:
        return self

    def __exit__(self, *error: object) -> None:
        self._archive.close()


def read_masks(path: Path | str) -> Masks:
    """Open the masks in an archive.

    Args:
        path: path of the archive, or of a sequence's folder with `drone_masks.zip`.

    Raises:
        InputError: the path cannot be read, the path of an image does not name camera, drone and frame, or two images
            belong to one camera, drone and frame.
    """
    path = Path(path)
    return Masks(path / MASKS if path.is_dir() else path)


def _index_images(path: Path, files: list[str]) -> dict[tuple[str, int, int], str]:
    """Names of the images by camera, drone and frame."""
    names: dict[tuple[str, int, int], str] = {}
    for name in files:
        place = PurePosixPath(name)
        if place.suffix.lower() not in _IMAGE_SUFFIXES or any(part[0] in "._" for part in place.parts):
            continue
        key = _parse_name(name.removesuffix(place.suffix))
        if key is None:
            raise InputError(path, expected=_EXPECTED, found=name)
        if key in names:
            raise InputError(
                path, expected="one image per camera, drone and frame", found=f"{names[key]} and {name}"
            )
        names[key] = name
    if not names:
        raise InputError(path, expected=_EXPECTED, found=", ".join(files[:3]) or "no files")
    return names


def _parse_name(name: str) -> tuple[str, int, int] | None:
    """Camera, drone and frame in the path of an image without its suffix."""
    camera, drone = _CAMERA.search(name), _DRONE.search(name)
    if camera is None or drone is None:
        return None
    rest = _DRONE.sub("/", _CAMERA.sub("/", name))
    numbers = _NUMBER.findall(rest.rpartition("/")[2]) or _NUMBER.findall(rest)
    return (camera_key(camera[0]), int(drone[1]), int(numbers[-1])) if numbers else None


def _png(mask: Mask) -> bytes:
    """Encode a mask as a 1-bit grey PNG (ISO/IEC 15948) that decodes to 0 and 255; five times as fast as OpenCV."""
    height, width = mask.shape
    rows = np.zeros(
        (height, 1 + (width + 7) // 8), np.uint8
    )  # each row starts with its filter; 0 is no filter
    rows[:, 1:] = np.packbits(mask, axis=1)
    # Run-length encoding is fast, and masks are nearly only runs of equal bytes.
    squeeze = zlib.compressobj(6, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    data = squeeze.compress(rows.tobytes()) + squeeze.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@functools.lru_cache(maxsize=4)
def _empty_png(height: int, width: int) -> bytes:
    return _png(np.zeros((height, width), bool))
