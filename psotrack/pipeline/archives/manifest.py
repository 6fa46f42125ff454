"""What an archive says of itself: its manifest, a JSON file, and the record of the run that made its tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from psotrack.errors import InputError
from psotrack.settings import TrackSettings
from psotrack.support import read_json

#: Name of the manifest in the archive and in the unpacked folder.
MANIFEST_FILE = "psotrack.json"
#: Version of the layout that this version of psotrack writes; it reads this version and all before.
FORMAT_VERSION = 1
#: Value of the key "format".
FORMAT = "psotrack archive"

Count = Annotated[int, msgspec.Meta(ge=0)]
_Content = TypeVar("_Content", bound=msgspec.Struct)


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
        files: paths of the files of the archive, without the manifest.
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
    files: tuple[str, ...] = ()

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


class TrackRecord(msgspec.Struct, frozen=True):
    """What archives need of the record of a run; a record has more (see the page on the contract)."""

    sequence: str
    cameras: list[str]
    frames: int
    frames_asked: int | None
    rate_hz: float
    settings: TrackSettings
    input_keys: dict[str, str]
    volume: dict[str, Any] = {}
    parts: dict[str, Any] = {}
    versions: dict[str, str] = {}
    device: dict[str, str] = {}
    causal: bool = False
    most_drones: int | None = None


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of an unpacked archive.

    Raises:
        InputError: there is no manifest, or it is that of a newer version.
    """
    path = folder / MANIFEST_FILE
    data = read_json(path, "the manifest of an archive of psotrack")
    version = data.get("version")
    if data.get("format") != FORMAT:
        raise InputError(path, expected="the manifest of an archive of psotrack", found="another JSON file")
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise InputError(
            path,
            expected=f"an archive of version {FORMAT_VERSION} or older",
            found=f"version {version}, written by psotrack {data.get('psotrack', 'of an unknown version')}",
            remedy="install a newer psotrack",
        )
    return _converted(path, data, Manifest, "a whole manifest")


def read_record(tracks: Path) -> TrackRecord:
    """Read the record that lies beside a file of tracks.

    Raises:
        InputError: there is no record, or it is not that of `track` of this version.
    """
    path, expected = tracks.with_suffix(".json"), "the record of the tracks, which `track` writes"
    if not path.is_file():
        raise InputError(path, expected=expected, found="no such file")
    return _converted(path, read_json(path, expected), TrackRecord, expected, "track again")


def _converted(
    path: Path, data: dict[str, Any], kind: type[_Content], expected: str, remedy: str = ""
) -> _Content:
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(path, expected=expected, found=f"{error}", remedy=remedy) from error
