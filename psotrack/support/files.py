"""Safe reading and writing of files, and digests of their content.

A file is first written under a temporary name beside its path and then renamed, so that an interrupted write never
damages an older file. A link is followed: the file that the link leads to is replaced. What is no regular file, such as
/dev/null or a pipe, is never replaced, and gets the finished bytes.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import platformdirs

from psotrack.errors import InputError, OutputError, system_errors

#: Longest name that becomes the name of a file, bytes.
_LONGEST_NAME = 180

#: Ending of the names of archives (`psotrack.pipeline.archives`).
ARCHIVE_SUFFIX = ".psotrack"

#: Hash functions of `digest_file`: BLAKE2b with 512 and with 160 bits, and SHA-256.
Algorithm = Literal["blake2b", "blake2b-160", "sha256"]

#: Names that `atomic_write` gives: stem of the output, machine and process that write, and a random part.
_TEMPORARY = re.compile(r"\.(.*)\.([0-9a-f]{4})-([0-9]+)-[0-9a-f]{8}\.partial")
_TO_C3D = "export C3D from that program"
#: First bytes of files that are not what their names say -> what they are, and what to do.
_OTHERS = {
    b"version https://git-lfs.github.com/": (
        "a Git LFS pointer, not the file itself",
        "`git lfs pull` gets the file",
    ),
    b"#ROSBAG V": ("a ROS 1 bag", "make MCAP of it with `rosbags-convert --dst-storage mcap`"),
    b"Format Version,": ("a table of OptiTrack Motive", _TO_C3D),
    b"Trajectories": ("a table of Vicon Nexus", _TO_C3D),
    b"NO_OF_FRAMES": ("a table of Qualisys Track Manager", _TO_C3D),
    b"PathFileType": ("a table of markers for OpenSim (TRC)", _TO_C3D),
}
#: Temporary files that this process writes just now.
_OPEN: set[Path] = set()


def refuse_to_overwrite(path: Path | str, force: bool) -> None:
    """Refuse an output before the work for it begins.

    Raises:
        OutputError: `path` is an existing file or folder and `force` is not set, `path` is `-` or a link that leads to
            itself, or its folder cannot be written.
    """
    path = Path(path)
    if path == Path("-"):
        # A file of this name would surprise users who mean stdout.
        raise OutputError(
            path, expected="the path of a file or folder", found="-, which is stdout for --json only"
        )
    if _takes_bytes(path):
        return
    if path.exists() and not force:
        found = "an existing folder" if path.is_dir() else "an existing file"
        raise OutputError(
            path, expected="a path that does not exist yet", found=found, remedy="pass --force to replace it"
        )
    folder = end_of_links(path).parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        found = f"{folder}, which cannot be written" if folder.is_dir() else f"{folder}, which is no folder"
        raise OutputError(path, expected="a path in a folder that can be written", found=found)


def refuse_files(*paths: Path | str, force: bool) -> None:
    """`refuse_to_overwrite` for files: a folder is refused also with `force`."""
    for path in paths:
        refuse_to_overwrite(path, force)
        _refuse_folder(Path(path))


def _refuse_folder(path: Path) -> None:
    # Even with `force`: a user who names a folder by mistake must not lose the folder's content.
    if path.is_dir():
        remedy = "name a file; the content of the folder is unchanged"
        raise OutputError(path, expected="the path of a file", found="a folder", remedy=remedy)


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path next to `path`; at the end of the block what was written there replaces `path`.

    If the block raises (Ctrl-C included), the temporary file or folder is removed and `path` is unchanged. The
    temporary name has the suffix of `path`, because writers of videos and images choose their format by the suffix.

    A link at `path` stays, and what it leads to is replaced. A device or a pipe at `path` stays too, and gets the bytes
    of the file at the end of the block. A path that another `atomic_write` yielded is yielded again.

    Raises:
        OutputError: the folder cannot be written, the disk is full, `path` is a folder and a file was written, or
            `path` is a link that leads to itself.
    """
    path = Path(path)
    if not _TEMPORARY.match(path.name):
        with atomic_write_all(path) as (temporary,):
            yield temporary
        return
    try:
        yield path
    except OSError as error:
        # The outer `atomic_write_all` names the file of the set by it.
        error.filename = str(path)
        raise


@contextlib.contextmanager
def atomic_write_all(*paths: Path | str) -> Iterator[tuple[Path, ...]]:
    """`atomic_write` of files that belong together.

    After an error in the block, and where one of the paths cannot be replaced, all of them are unchanged. Files are
    replaced in the order of `paths`: name a file after those without which it must not be.
    """
    outputs: list[_Output] = []
    try:
        for path in map(Path, paths):
            with _errors_of([_Output(path, path, path)]):
                outputs.append(_prepare(path))
                _OPEN.add(outputs[-1].temporary)
        with _errors_of(outputs):
            yield tuple(output.temporary for output in outputs)
        for output in outputs:
            if not output.temporary.is_dir():
                _refuse_folder(output.path)
        for output in outputs:
            with _errors_of([output]):
                output.publish()
    finally:
        for output in outputs:
            _remove(output.temporary)
            _OPEN.discard(output.temporary)


@dataclass(frozen=True)
class _Output:
    """A file or folder that is being written.

    Attributes:
        path: the path as the caller names it.
        target: what is replaced, at the end of the links; a device or a pipe gets the bytes.
        temporary: what is written first.
    """

    path: Path
    target: Path
    temporary: Path

    def publish(self) -> None:
        if not _takes_bytes(self.target):
            _replace(self.temporary, self.target)
            return
        with self.temporary.open("rb") as content, self.target.open("ab") as taker:
            shutil.copyfileobj(content, taker)


def _prepare(path: Path) -> _Output:
    random = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    name = f".{path.stem}.{random}.partial{path.suffix}"
    if _takes_bytes(path):
        return _Output(path, path, Path(tempfile.gettempdir()) / name)
    target = end_of_links(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # What killed processes have left of the same output.
    for rest in _left_over(target.parent.resolve()):
        if (found := _TEMPORARY.match(rest.name)) and found[1] == path.stem:
            _remove(rest)
    return _Output(path, target, target.with_name(name))


def remove_temporary_files() -> None:
    """Remove what `atomic_write` of this process is writing: for a program that ends without its clean-up."""
    for path in list(_OPEN):
        _remove(path)


def left_over(folder: Path) -> tuple[Path, ...]:
    """Temporary files of `atomic_write` that killed processes of this machine have left in a folder."""
    with contextlib.suppress(OSError):
        found = [(path, _TEMPORARY.match(path.name)) for path in folder.glob(".*.partial*")]
        return tuple(
            path
            for path, parts in found
            if parts and parts[2] == _machine() and not _is_running(int(parts[3]))
        )
    return ()


#: A process looks once: listing a folder of 10,000 results takes longer than writing one.
_left_over = functools.lru_cache(maxsize=1000)(left_over)


def _is_running(process: int) -> bool:
    """Whether a process of this machine runs; where this is not known, it may."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


@functools.cache
def _machine() -> str:
    """Four hexadecimal digits of the machine's name: on a network file system, other machines have other processes."""
    return hashlib.blake2b(platform.node().encode(), digest_size=2).hexdigest()


@contextlib.contextmanager
def _errors_of(outputs: Sequence[_Output]) -> Iterator[None]:
    """Errors of the system within the block become an `OutputError` of the output that they name, or of the last."""
    try:
        yield
    except OSError as error:
        named = [output for output in outputs if str(error.filename) == str(output.temporary)]
        output = (named or outputs)[-1]
        raise OutputError(
            output.path,
            expected="a path that can be written",
            found=error.strerror or str(error),
            remedy="earlier results are unchanged",
        ) from error
    except OutputError as error:
        # Writers name the temporary file, which is gone when users read the message.
        message = str(error)
        for output in outputs:
            message = message.replace(str(output.temporary), str(output.path))
        error.args = (message,)
        raise


def _takes_bytes(path: Path) -> bool:
    """Whether a path is something other than a file or folder: a device, a pipe or a socket, also through links.

    /dev/stdout is one too where stdout is a file: the file belongs to the shell.
    """
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) or path.as_posix().startswith(
        ("/dev/std", "/dev/fd/")
    )


def end_of_links(path: Path) -> Path:
    """What a link leads to, whether it exists or not; a path that is no link as it is.

    Raises:
        OutputError: the link leads to itself.
    """
    if not path.is_symlink():
        return path
    # Python 3.13 no longer raises where links go round in a circle.
    with contextlib.suppress(RuntimeError, OSError):
        end = path.resolve()
        if not end.is_symlink():
            return end
    raise OutputError(
        path, expected="a link that leads to a file", found="a link that leads to itself", remedy="remove it"
    )


def read_text(path: Path | str) -> str:
    """Read a UTF-8 text file, without the byte order mark that spreadsheet programs write first.

    Raises:
        InputError: the file cannot be read, is not UTF-8 text, or is a known file of another program.
    """
    check_kind(path, "a text that psotrack reads")
    try:
        with system_errors(path, "a file to read"):
            text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            path, expected="UTF-8 text", found=f"an invalid byte at offset {error.start}"
        ) from error
    # A NUL is of a damaged file, or of a text in UTF-16 or UTF-32.
    if "\0" in text:
        raise InputError(path, expected="UTF-8 text", found=f"a NUL at character {text.index(chr(0))}")
    return text


def check_kind(path: Path | str, expected: str) -> None:
    """Raise `InputError` for a file whose first bytes are those of another program's kind of file, which it names.

    Args:
        path: the file; one that cannot be read passes.
        expected: noun phrase for the file, for the message.
    """
    with contextlib.suppress(OSError), Path(path).open("rb") as file:
        start = file.read(100).removeprefix(b"\xef\xbb\xbf")
        for first, (found, remedy) in _OTHERS.items():
            if start.startswith(first):
                raise InputError(path, expected=expected, found=found, remedy=remedy)


def check_file_name(name: str, where: object) -> str:
    """Return a name, such as that of a camera, that becomes the name of a file; on any system it stays in its folder.

    Args:
        name: the name, without a suffix.
        where: where the name comes from, for the message.

    Raises:
        InputError: the name has a mark that leads to another folder, or that no system allows, or is too long.
    """
    is_plain = name.isprintable() and name == name.strip() and name.strip(".")
    # With a suffix, and the marks of a temporary name, names of files have at most 255 bytes.
    if not is_plain or set(name) & set('/\\:*?"<>|') or len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(
            where,
            expected="names that can be names of files",
            found=repr(name),
            remedy="rename it: no / \\ : and other marks of paths",
        )
    return name


def digest_file(
    path: Path | str, *, algorithm: Algorithm = "blake2b", expected: str = "a readable file"
) -> str:
    """Digest of a file's content, as hexadecimal digits.

    Args:
        path: path of the file; it is read in pieces.
        algorithm: hash function.
        expected: kind of file, for the message.

    Raises:
        InputError: the file cannot be read.
    """
    new = (lambda: hashlib.blake2b(digest_size=20)) if algorithm == "blake2b-160" else algorithm
    with system_errors(path, expected), Path(path).open("rb") as file:
        return hashlib.file_digest(file, new).hexdigest()


def digest_record(record: Any) -> str:
    """Digest of plain data and msgspec records, as 40 hexadecimal digits (BLAKE2b of their JSON with sorted keys)."""
    text = msgspec.json.encode(record, order="deterministic")
    return hashlib.blake2b(text, digest_size=20).hexdigest()


def _replace(temporary: Path, path: Path) -> None:
    if not path.is_dir():
        os.replace(temporary, path)
        return
    # A folder cannot be replaced in one step: the old folder is renamed first, and gets its name back after a failure.
    aside = temporary.with_name(f"{temporary.name}.old")
    os.replace(path, aside)
    try:
        os.replace(temporary, path)
    except OSError:
        os.replace(aside, path)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def user_cache() -> Path:
    """The user's cache folder for silhouettes and compiled programs: $PSOTRACK_CACHE, or the system's usual place."""
    chosen = os.environ.get("PSOTRACK_CACHE")
    return Path(chosen) if chosen else platformdirs.user_cache_path("psotrack") / "silhouettes"
