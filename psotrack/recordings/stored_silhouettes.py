"""Stored silhouettes of one camera: where they lie, and what they were made of; they take the place of a video.

The room `silhouettes` makes and reads the arrays of silhouettes. Here only their description is read: a recording needs
to know how many frames there are, and from what the silhouettes were made. This module does not import JAX, because
worker processes import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import msgspec

from psotrack.errors import InputError
from psotrack.support import digest_record, read_json

#: Name of the description in the folder of a zarr array.
ARRAY_FILE = "zarr.json"
#: Attribute of the array: everything that the silhouettes depend on.
MADE_OF = "made_of"


@dataclass(frozen=True)
class StoredSilhouettes:
    """Silhouettes of one camera in a folder.

    Attributes:
        path: folder of the zarr array.
        num_frames: number of frames to use, at most the number of frames that are stored.
        made_of: what the silhouettes were made of: "schema", "content" (digest of the video), "num_frames" and
            "settings" and "background"; "ignore" where the silhouettes depend on it.
    """

    path: Path
    num_frames: int
    made_of: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Digest of what the silhouettes were made of, in 40 digits; of the first frames only, another digest."""
        if self.num_frames == self.made_of["num_frames"]:
            return digest_record(self.made_of)
        return digest_record({**self.made_of, "first_frames": self.num_frames})


#: Identity of a background model, as of `identify`.
_Model = TypedDict("_Model", {"class": str, "key": dict[str, Any]})


class _MadeOf(msgspec.Struct, frozen=True):
    schema: int
    content: str
    num_frames: int
    settings: dict[str, Any]
    background: _Model


def probe_silhouettes(path: Path | str) -> StoredSilhouettes:
    """Read the description of stored silhouettes; their frames are not read.

    Args:
        path: folder of the silhouettes of one camera, as the store of silhouettes and archives have it.

    Raises:
        InputError: the folder holds no silhouettes, or they do not say what they were made of.
    """
    path = Path(path)
    file, remedy = path / ARRAY_FILE, "silhouettes of an archive, and those that this version stores, say it"
    expected = "the description of silhouettes that say what they were made of"
    if not file.is_file():
        raise InputError(path, expected="a folder with stored silhouettes", found=f"no {ARRAY_FILE}")
    content = read_json(file, expected, remedy)
    try:
        made_of, shape = content["attributes"][MADE_OF], content["shape"]
        num_frames = msgspec.convert(made_of, _MadeOf).num_frames
        stored = msgspec.convert(shape, tuple[int, int, int])[0]
    except (KeyError, TypeError, msgspec.ValidationError) as error:
        raise InputError(file, expected=expected, found=f"{error}", remedy=remedy) from error
    if stored != num_frames:
        raise InputError(file, expected=f"{num_frames} frames", found=f"{stored}")
    return StoredSilhouettes(path, stored, made_of)
