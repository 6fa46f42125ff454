"""The manifest of an archive: a JSON file that says what the archive holds, and how its tracks were made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from psotrack.errors import InputError
from psotrack.settings import TrackSettings

#: Name of the manifest in the archive and in the unpacked folder.
MANIFEST_FILE = "psotrack.json"
#: Version of the layout that this version of psotrack writes; it reads this version and all before.
FORMAT_VERSION = 1
#: Value of the key "format".
FORMAT = "psotrack archive"

Count = Annotated[int, msgspec.Meta(ge=0)]


class PackedFile(msgspec.Struct, frozen=True):
    """A file of an archive.

    Attributes:
        size: number of bytes.
        blake2b: digest of the content, BLAKE2b with 160 bits as hexadecimal digits.
    """

    size: Count
    blake2b: str


class PackedVideo(msgspec.Struct, frozen=True, kw_only=True):
    """The video from which a camera's silhouettes were made.

    Attributes:
        name: name of the file, or of the folder of its pictures.
        frames: number of frames.
        digest: digest of the content (see `psotrack.recordings.digest_video`).
        packed_as: path in the archive; None where the archive does not hold the video.
    """

    name: str
    frames: Count
    digest: str
    packed_as: str | None = None


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """Content of the manifest.

    Attributes:
        format: always `FORMAT`.
        version: version of the layout.
        psotrack: version of psotrack that wrote the archive.
        sequence: name of the recording.
        tracks: path of the tracks in the archive; their record has the same name with the suffix .json.
        settings: settings with which the tracks are computed again. Values that were found from the data are left open,
            and paths lead into the archive.
        frames: number of instants to use from the start, at the recording's own rate; None for all.
        causal: whether the tracks were computed without the future.
        most_drones: largest number of drones at one time of such tracks; None where it is not known.
        videos: the videos by camera name.
        files: the files of the archive by path, without the manifest.
    """

    format: str = FORMAT
    version: Count = FORMAT_VERSION
    psotrack: str
    sequence: str
    tracks: str
    settings: dict[str, Any]
    frames: int | None = None
    causal: bool = False
    most_drones: int | None = None
    videos: Mapping[str, PackedVideo] = {}
    files: Mapping[str, PackedFile] = {}

    @property
    def record(self) -> str:
        """Path of the record of the tracks in the archive."""
        return Path(self.tracks).with_suffix(".json").as_posix()

    def track_settings(self) -> TrackSettings:
        """The settings with which the tracks are computed again; paths lead into the archive.

        Raises:
            msgspec.ValidationError: this version of psotrack does not know such settings.
        """
        return msgspec.convert(self.settings, TrackSettings)


def manifest_of(content: bytes, where: Path) -> Manifest:
    """The manifest from its JSON.

    Args:
        content: content of the manifest.
        where: the archive or the manifest, for messages.

    Raises:
        InputError: the content is no manifest, or that of a newer version.
    """
    try:
        data = msgspec.json.decode(content)
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise InputError(
                where, expected="an archive of psotrack", found=f"{MANIFEST_FILE} of another kind"
            )
        version = data.get("version")
        if isinstance(version, int) and version > FORMAT_VERSION:
            raise InputError(
                where,
                expected=f"an archive of version {FORMAT_VERSION} or older",
                found=f"version {version}, written by psotrack {data.get('psotrack', 'of an unknown version')}",
                remedy="install a newer psotrack",
            )
        return msgspec.convert(data, Manifest)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(where, expected=f"a whole {MANIFEST_FILE}", found=f"{error}") from error


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of an unpacked archive.

    Raises:
        InputError: there is no manifest, or it is that of a newer version.
    """
    path = folder / MANIFEST_FILE
    try:
        content = path.read_bytes()
    except OSError as error:
        found = (error.strerror or f"{error}").lower()
        raise InputError(path, expected="the manifest of an archive", found=found) from error
    return manifest_of(content, path)
