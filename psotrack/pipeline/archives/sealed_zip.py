"""The file of an archive: a zip file with a manifest, and with a digest of the whole file at its end.

The seal, the last 40 bytes, is BLAKE2b of all bytes before it (160 bits, as hexadecimal digits). It is part of the zip
file's comment, so that every program that reads zip files opens an archive. The checksums of a zip file cover the
content of its files only; the seal shows every change, and an archive that was cut short. Dates are fixed and files
have a fixed order: equal content gives equal bytes.

An archive may come from anybody. Names that lead out of the folder, links, two files of one name, and files longer than
the manifest says are refused before anything is written under the final name.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import IO

import msgspec

from psotrack.errors import InputError, OutputError
from psotrack.pipeline.archives.manifest import MANIFEST_FILE, Manifest, PackedFile, manifest_of
from psotrack.support import Report, atomic_write, digest_file, no_progress, refuse_to_overwrite

#: What becomes a file of an archive: a file, or its content.
Source = Path | bytes

#: The seal's number of hexadecimal digits, and the bytes of the digest.
_SEAL_DIGITS, _DIGEST_BYTES = 40, 20
_COMMENT = b"psotrack archive, BLAKE2b-160 of all bytes before these digits: "
#: First bytes of a zip file.
_MAGIC = b"PK\x03\x04"
_DATE = (1980, 1, 1, 0, 0, 0)
#: Files whose content is compressed already.
_COMPRESSED = frozenset({".avi", ".mp4", ".mkv", ".mov", ".png", ".jpg", ".jpeg", ".parquet", ""})
#: Bytes that are read or written together.
_PIECE = 1 << 20
#: Largest size of a manifest, bytes: a day of sixteen cameras has a tenth of it.
_MOST_MANIFEST = 1 << 28
#: Bytes that every archive may unpack to, and how many times its own size a larger one. Tables of numbers, which shrink
#: most of what is packed, have a tenth of that.
_SMALL, _MOST_RATIO = 1 << 28, 100


def write_sealed(
    path: Path, manifest: Manifest, files: Mapping[str, Source], *, force: bool, report: Report
) -> Manifest:
    """Write an archive.

    Args:
        path: path of the archive.
        manifest: the manifest, without the list of files.
        files: the files by their paths in the archive.
        force: replace an existing file.
        report: shows the progress in MiB.

    Returns:
        The manifest as it was written.

    Raises:
        InputError: a file cannot be read, or changes while it is packed.
        OutputError: the archive exists and `force` is not set, or it cannot be written.
    """
    refuse_to_overwrite(path, force)
    for name in files:
        _check_name(path, name)
    listed = {name: _described(source) for name, source in files.items()}
    manifest = msgspec.structs.replace(manifest, files=listed)
    content = msgspec.json.format(msgspec.json.encode(manifest, order="deterministic"), indent=1)
    sizes = {MANIFEST_FILE: len(content)} | {name: each.size for name, each in listed.items()}
    with atomic_write(path) as temporary:
        with (
            zipfile.ZipFile(temporary, "w", allowZip64=True) as zipped,
            report("pack", sum(sizes.values()) >> 20) as advance,
        ):
            done = 0
            zipped.comment = _COMMENT + bytes(_SEAL_DIGITS)
            for name, source in {MANIFEST_FILE: content, **files}.items():
                with zipped.open(_entry(name, sizes[name]), "w") as packed:
                    for piece in _pieces_of(source):
                        packed.write(piece)
                        advance((done + len(piece) >> 20) - (done >> 20))
                        done += len(piece)
        for name, source in files.items():
            if isinstance(source, Path) and zipped.getinfo(name).file_size != sizes[name]:
                raise InputError(source, expected="a file that stays as it is", found="another length")
        with temporary.open("r+b") as file:
            seal = _seal_of(file)
            file.seek(-_SEAL_DIGITS, 2)
            file.write(seal)
    return manifest


def unpack(
    archive: Path | str, folder: Path | str, *, force: bool = False, report: Report = no_progress
) -> Manifest:
    """Unpack an archive into a new folder, after all of it was checked.

    Args:
        archive: path of the archive.
        folder: the folder.
        force: replace an existing folder, if an archive was unpacked there.
        report: shows the progress in MiB.

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
    with _opened(archive) as (zipped, manifest), atomic_write(folder) as temporary:
        temporary.mkdir()
        with report("unpack", sum(each.size for each in manifest.files.values()) >> 20) as advance:
            done = 0
            for name, described in manifest.files.items():
                target = temporary / name
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as file:
                    for piece in _checked_pieces(archive, zipped, name, described):
                        file.write(piece)
                        advance((done + len(piece) >> 20) - (done >> 20))
                        done += len(piece)
        with zipped.open(MANIFEST_FILE) as packed, (temporary / MANIFEST_FILE).open("xb") as file:
            shutil.copyfileobj(packed, file)
    return manifest


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[zipfile.ZipFile, Manifest]]:
    """The zip file and the manifest of an archive whose seal, version and list of files are right."""
    _check_seal(path)
    try:
        with zipfile.ZipFile(path) as zipped:
            entries = zipped.infolist()
            _check_entries(path, entries)
            _check_ratio(path, entries)
            manifest = _read_manifest(path, zipped)
            _check_listed(path, {entry.filename: entry.file_size for entry in entries}, manifest)
            yield zipped, manifest
    # Whatever the seal proves, a zip file may be wrong in more ways than `zipfile` has exceptions for.
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        RuntimeError,
        struct.error,
        ValueError,
    ) as error:
        raise InputError(
            path, expected="an archive of psotrack", found=f"a wrong zip file: {error}"
        ) from error


def _check_seal(path: Path) -> None:
    """Raise `InputError` unless the digest at the end of a file is that of all bytes before it."""
    try:
        with path.open("rb") as file:
            begins = file.read(len(_MAGIC))
            length = file.seek(0, 2)
            if length > len(_MAGIC) + _SEAL_DIGITS and begins == _MAGIC:
                seal = _seal_of(file)
                if file.read(_SEAL_DIGITS) == seal:
                    return
    except OSError as error:
        found = (error.strerror or f"{error}").lower()
        raise InputError(path, expected="an archive of psotrack", found=found) from error
    if begins != _MAGIC:
        raise InputError(path, expected="an archive of psotrack", found="another file")
    raise InputError(
        path,
        expected="a whole archive of psotrack",
        found="one that was cut short or changed",
        remedy="copy it again, or pack it again",
    )


def _seal_of(file: IO[bytes]) -> bytes:
    """Digest of all bytes of a file before the seal, where the file stands then."""
    left = file.seek(0, 2) - _SEAL_DIGITS
    file.seek(0)
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    while left > 0:
        piece = file.read(min(_PIECE, left))
        if not piece:
            break
        digest.update(piece)
        left -= len(piece)
    return digest.hexdigest().encode()


def _entry(name: str, size: int) -> zipfile.ZipInfo:
    """A file of the zip file, with nothing in it that depends on the machine or the time."""
    entry = zipfile.ZipInfo(name, _DATE)
    entry.create_system = 3  # Unix
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    entry.file_size = size
    is_compressed = PurePosixPath(name).suffix.lower() in _COMPRESSED
    entry.compress_type = zipfile.ZIP_STORED if is_compressed else zipfile.ZIP_DEFLATED
    return entry


def _described(source: Source) -> PackedFile:
    if isinstance(source, bytes):
        return PackedFile(len(source), hashlib.blake2b(source, digest_size=_DIGEST_BYTES).hexdigest())
    return PackedFile(source.stat().st_size, digest_file(source, algorithm="blake2b-160"))


def _pieces_of(source: Source) -> Iterator[bytes]:
    if isinstance(source, bytes):
        yield source
        return
    with source.open("rb") as file:
        while piece := file.read(_PIECE):
            yield piece


def _checked_pieces(path: Path, zipped: zipfile.ZipFile, name: str, described: PackedFile) -> Iterator[bytes]:
    """The content of a file of an archive, never longer than the manifest says."""
    digest, left = hashlib.blake2b(digest_size=_DIGEST_BYTES), described.size
    with zipped.open(name) as packed:
        # One byte more than there should be shows that the file is longer.
        while piece := packed.read(min(_PIECE, left + 1)):
            left -= len(piece)
            if left < 0:
                break
            digest.update(piece)
            yield piece
    if left or digest.hexdigest() != described.blake2b:
        expected = f"{described.size} bytes with the digest of {MANIFEST_FILE}"
        raise InputError(f"{path}, {name}", expected=expected, found="others")


def _read_manifest(path: Path, zipped: zipfile.ZipFile) -> Manifest:
    if MANIFEST_FILE not in zipped.namelist():
        raise InputError(
            path, expected=f"an archive of psotrack, with {MANIFEST_FILE}", found="another zip file"
        )
    with zipped.open(MANIFEST_FILE) as packed:
        content = packed.read(_MOST_MANIFEST + 1)
    if len(content) > _MOST_MANIFEST:
        raise InputError(f"{path}, {MANIFEST_FILE}", expected=f"at most {_MOST_MANIFEST} bytes", found="more")
    return manifest_of(content, path)


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Raise `InputError` for a name that leads out of the folder, a link, and two files of one name."""
    seen: set[str] = set()
    for entry in entries:
        _check_name(path, entry.filename)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG):
            found = "a link" if kind == stat.S_IFLNK else "something else"
            raise InputError(f"{path}, {entry.filename}", expected="a file", found=found)
        # Two names that differ in case only are one file on some systems.
        if entry.filename.casefold() in seen:
            raise InputError(f"{path}, {entry.filename}", expected="each file once", found="the file twice")
        seen.add(entry.filename.casefold())


def _check_ratio(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Raise `InputError` for an archive that unpacks to far more than it could have been made from."""
    size, most = sum(entry.file_size for entry in entries), max(_SMALL, _MOST_RATIO * path.stat().st_size)
    if size > most:
        expected = f"files of at most {most} bytes in an archive of {path.stat().st_size}"
        raise InputError(path, expected=expected, found=f"{size} bytes", remedy="do not trust it")


def _check_name(path: Path, name: str) -> None:
    """Raise `InputError` for the name of a file that could lie outside of the folder, on any system."""
    parts = name.split("/")
    is_inside = all(part not in ("", ".", "..") for part in parts)
    if not is_inside or not name.isprintable() or any(mark in name for mark in "\\:"):
        raise InputError(
            path, expected="names of files inside of the folder", found=f"{name!r}", remedy="do not trust it"
        )


def _check_listed(path: Path, sizes: Mapping[str, int], manifest: Manifest) -> None:
    """Raise `InputError` unless the manifest lists exactly the files of the zip file, with their sizes."""
    listed = {name: each.size for name, each in manifest.files.items()}
    found = {name: size for name, size in sizes.items() if name != MANIFEST_FILE}
    for name in sorted(listed.keys() | found):
        if listed.get(name) != found.get(name):
            expected, has = (
                "no such file" if size is None else f"{size} bytes"
                for size in (listed.get(name), found.get(name))
            )
            raise InputError(f"{path}, {name}", expected=f"{expected}, as {MANIFEST_FILE} says", found=has)
    for name in (manifest.tracks, manifest.record):
        if name not in listed:
            raise InputError(f"{path}, {MANIFEST_FILE}", expected=f"the file {name}", found="none")
