"""The file of an archive: a zip file with a manifest, which any program for zip files opens.

The manifest is a JSON file; it says of what recording and run the archive is. The checksums of a zip file show a change
of its files, and an archive that was cut short. Dates are fixed and files have a fixed order: equal content gives equal
bytes.

An archive may come from anybody. Names that lead out of the folder, two files of one name, and files that unpack to far
more than the archive has are refused. The folder gets its name when everything was unpacked and checked.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec

from psotrack.errors import InputError, OutputError, PsotrackError, system_errors
from psotrack.settings import TrackSettings
from psotrack.support import Report, atomic_write, convert, no_progress, read_json, refuse_to_overwrite

#: Name of the manifest in the archive and in the unpacked folder.
MANIFEST_FILE = "psotrack.json"
#: Version of the layout that this version of psotrack writes; it reads this version and all before.
FORMAT_VERSION = 1
#: Value of the key "format".
FORMAT = "psotrack archive"

Count = Annotated[int, msgspec.Meta(ge=0)]


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
    return convert(data, Manifest, f"{path}, ")


def read_record(tracks: Path) -> TrackRecord:
    """Read the record that lies beside a file of tracks.

    Raises:
        InputError: there is no record, or it is not that of `track` of this version.
    """
    path, expected = tracks.with_suffix(".json"), "the record of the tracks, which `track` writes"
    if not path.is_file():
        raise InputError(path, expected=expected, found="no such file")
    return convert(read_json(path, expected), TrackRecord, f"{path}, ")


#: What becomes a file of an archive: a file, or its content.
Source = Path | bytes

_DATE = (1980, 1, 1, 0, 0, 0)
#: Files whose content is compressed already.
_COMPRESSED = frozenset({".avi", ".mp4", ".mkv", ".mov", ".png", ".jpg", ".jpeg", ".parquet", ""})
#: Bytes that every archive may unpack to, and how many times its own size a larger one. Tables of numbers, which shrink
#: most of what is packed, have a tenth of that.
_SMALL, _MOST_RATIO = 1 << 28, 100


def write_archive(
    path: Path, manifest: Manifest, files: Mapping[str, Source], *, force: bool, report: Report
) -> Manifest:
    """Write an archive.

    Args:
        path: path of the archive.
        manifest: the manifest, without the list of files.
        files: the files by their paths in the archive.
        force: replace an existing file.
        report: shows the progress in files.

    Returns:
        The manifest as it was written.

    Raises:
        InputError: a file cannot be read.
        OutputError: the archive exists and `force` is not set, or it cannot be written.
    """
    refuse_to_overwrite(path, force)
    _check_names(path, list(files))
    for source in files.values():
        if isinstance(source, Path) and not os.access(source, os.R_OK):
            raise InputError(source, expected="a file that can be read", found="none")
    manifest = msgspec.structs.replace(manifest, files=tuple(files))
    content = msgspec.json.format(msgspec.json.encode(manifest, order="deterministic"), indent=1)
    with (
        atomic_write(path) as temporary,
        zipfile.ZipFile(temporary, "w") as zipped,
        report("pack", len(files) + 1) as advance,
    ):
        for name, source in {MANIFEST_FILE: content, **files}.items():
            if isinstance(source, bytes):
                zipped.writestr(_entry(name, len(source)), source)
            else:
                with (
                    source.open("rb") as file,
                    zipped.open(_entry(name, source.stat().st_size), "w") as packed,
                ):
                    shutil.copyfileobj(file, packed)
            advance(1)
    return manifest


def unpack(
    archive: Path | str, folder: Path | str, *, force: bool = False, report: Report = no_progress
) -> Manifest:
    """Unpack an archive into a new folder.

    Args:
        archive: path of the archive.
        folder: the folder; it appears when all of the archive was checked.
        force: replace an existing folder, if an archive was unpacked there.
        report: shows the progress in files.

    Returns:
        The manifest of the archive.

    Raises:
        InputError: the archive was cut short or changed, is of a newer version, or would write outside of the folder.
        OutputError: the folder exists and `force` is not set, or it cannot be written.
    """
    archive, folder = Path(archive), Path(folder)
    refuse_to_overwrite(folder, force)
    if folder.exists() and not (folder / MANIFEST_FILE).is_file():
        raise OutputError(
            folder,
            expected="a folder into which an archive was unpacked",
            found="another folder or file",
            remedy="name a path that does not exist yet",
        )
    with _opened(archive) as zipped, atomic_write(folder) as temporary:
        temporary.mkdir()
        with report("unpack", len(zipped.infolist())) as advance:
            for entry in zipped.infolist():
                zipped.extract(entry, temporary)
                advance(1)
        manifest = _manifest_of(archive, temporary, zipped)
    return manifest


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip file of an archive, after its names and sizes were checked."""
    try:
        with system_errors(path, "an archive of psotrack"):
            zipped = zipfile.ZipFile(path)
        with zipped:
            entries = zipped.infolist()
            if any(entry.header_offset < 0 for entry in entries):
                # `zipfile` would raise an OSError, which is taken for one of the folder's.
                raise zipfile.BadZipFile("bytes at the beginning are missing")
            _check_names(path, [entry.filename for entry in entries])
            size = sum(entry.file_size for entry in entries)
            if size > (most := max(_SMALL, _MOST_RATIO * path.stat().st_size)):
                expected = f"files of at most {most} bytes in an archive of {path.stat().st_size}"
                raise InputError(path, expected=expected, found=f"{size} bytes", remedy="do not trust it")
            yield zipped
    # A zip file may be wrong in more ways than `zipfile` has exceptions for.
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        RuntimeError,
        struct.error,
        ValueError,
    ) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(
        path,
        expected="a whole archive of psotrack",
        found=f"another file, or one that was cut short or changed ({error})",
        remedy="copy it again, or pack it again",
    )


def _manifest_of(archive: Path, folder: Path, zipped: zipfile.ZipFile) -> Manifest:
    """The manifest of an archive that was unpacked; it lists exactly the files that are there."""
    try:
        manifest = read_manifest(folder)
    except PsotrackError as error:
        # The folder has a temporary name.
        error.args = (f"{archive}, {error}".replace(f"{folder}{os.sep}", ""),)
        raise
    different = {*manifest.files, MANIFEST_FILE} ^ set(zipped.namelist())
    different |= {manifest.tracks, manifest.record} - set(manifest.files)
    if different:
        expected, name = f"the files that {MANIFEST_FILE} lists", min(different)
        raise InputError(archive, expected=expected, found=f"a difference: {name}")
    return manifest


def _entry(name: str, size: int) -> zipfile.ZipInfo:
    """A file of the zip file, with nothing in it that depends on the machine or the time."""
    entry = zipfile.ZipInfo(name, _DATE)
    entry.create_system = 3  # Unix
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    entry.file_size = size
    is_compressed = PurePosixPath(name).suffix.lower() in _COMPRESSED
    entry.compress_type = zipfile.ZIP_STORED if is_compressed else zipfile.ZIP_DEFLATED
    return entry


def _check_names(path: Path, names: list[str]) -> None:
    """Raise `InputError` for a name that could lie outside of the folder, on any system, or that is there twice."""
    seen: set[str] = set()
    for name in names:
        is_inside = all(part not in ("", ".", "..") for part in name.split("/"))
        if not is_inside or not name.isprintable() or any(mark in name for mark in "\\:"):
            expected = "names of files inside of the folder"
            raise InputError(path, expected=expected, found=f"{name!r}", remedy="do not trust it")
        # Two names that differ in case only are one file on some systems.
        if name.casefold() in seen:
            raise InputError(path, expected="each file once", found=f"{name} twice")
        seen.add(name.casefold())
