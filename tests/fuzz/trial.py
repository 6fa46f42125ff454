"""One try: a changed file is given to a public function or a command, and what happens is judged.

The property: the call succeeds, or raises a `PsotrackError` of one line with at most `LONGEST` characters that names
the file or a file beside it; a command then has exit code 2, that line as last line on stderr, and nothing else there
but warnings of one line. Nothing is written or changed beside the input; after an error nothing is written at all. No
library writes to stderr. Processor time and memory are at most twice those of the sound file, plus `SECONDS`
and `MEBIBYTES`.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from fuzz.formats import FORMATS, make_all
from fuzz.mutations import mutate
from psotrack import cli
from psotrack.errors import PsotrackError

#: Longest message, characters; the folders of the tries do not count.
LONGEST = 300
#: What a try may take beside twice what the sound file takes.
SECONDS, MEBIBYTES = 2.0, 256
#: Share of the tries that run a command.
COMMANDS = 0.05


#: Streams of Python to the file descriptors, whatever else pytest has made of `sys.stdout`.
_STREAMS = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115


@dataclass(frozen=True)
class Trial:
    """What a try is made of, and what happened.

    Attributes:
        number: number of the try.
        name: name of the format.
        call: name of the function, or the command.
        fault: which part of the property is wrong; "" if none is.
        is_refused: whether the file was refused.
        content: the changed content.
    """

    number: int
    name: str
    call: str
    fault: str
    is_refused: bool
    content: bytes = field(repr=False)


@dataclass
class _Cost:
    seconds: float = 0.0
    mebibytes: float = 0.0


class Judge:
    """Makes tries in a folder of its own.

    Args:
        folder: a folder that does not exist yet.
        seed: seed of all tries.
        names: names of the formats.
    """

    def __init__(self, folder: Path, seed: int, names: tuple[str, ...] = tuple(FORMATS)) -> None:
        self._folder, self._seed, self._names = folder, seed, names
        self._seeds, self._out = folder / "in", folder / "out"
        make_all(self._seeds, names)
        self._sound = {name: (self._seeds / name / FORMATS[name].file).read_bytes() for name in names}
        self._costs: dict[tuple[str, str], _Cost] = {}

    def attempt(self, number: int) -> Trial:
        """Make the try of a number; equal seeds, formats and numbers give equal tries."""
        random = Random(f"{self._seed} {number}")
        name = self._names[number % len(self._names)]
        each, sound = FORMATS[name], self._sound[name]
        content = mutate(random, sound, [*self._sound.values()], each.inside)
        by_command = bool(each.command) and (not each.reads or random.random() < COMMANDS)
        read = None if by_command else random.choice(each.reads)
        return self.judge(number, name, read, content)

    def judge(self, number: int, name: str, read: Callable | None, content: bytes) -> Trial:
        """Give a content to a function, or with None to the command of the format."""
        each = FORMATS[name]
        path = self._seeds / name / each.file
        call = each.command if read is None else f"reads[{each.reads.index(read)}]"
        if (name, call) not in self._costs:
            # Twice, because the first call imports libraries.
            for _ in range(2):
                fault, is_refused, cost = self._run(path, name, read, None)
            self._costs[name, call] = cost
            if fault or is_refused != each.is_refused:
                return Trial(number, name, call, f"the sound file: {fault or 'refused'}", is_refused, content)
        path.write_bytes(content)
        try:
            fault, is_refused, _ = self._run(path, name, read, self._costs[name, call])
        finally:
            path.write_bytes(self._sound[name])
        return Trial(number, name, call, fault, is_refused, content)

    def _run(
        self, path: Path, name: str, read: Callable | None, limit: _Cost | None
    ) -> tuple[str, bool, _Cost]:
        shutil.rmtree(self._out, ignore_errors=True)
        self._out.mkdir()
        before = _listing(self._seeds / name)
        held = _begin_memory()
        began_s = time.process_time()
        with _captured() as said:
            message, fault = self._command(name, path) if read is None else _function(read, path)
        cost = _Cost(time.process_time() - began_s, _peak_memory() - held)
        text = said()
        allowed = read is None
        if not fault and message is not None:
            fault = _wrong_message(message, path, self._seeds / name)
        lines = text.splitlines()
        if not fault and allowed and message is not None:
            lines = lines[:-1]
        strange = [line for line in lines if not (allowed and line.startswith("psotrack: warning: "))]
        if not fault and strange:
            fault = f"stderr: {strange[0][:300]}"
        if not fault and _listing(self._seeds / name) != before:
            fault = "a file beside the input was written or changed"
        if not fault and message is not None and any(self._out.iterdir()):
            fault = f"written in spite of the error: {sorted(self._out.rglob('*'))[:3]}"
        if not fault and limit is not None:
            # Memory first: where the machine has little of it, it also takes time.
            if cost.mebibytes > 2 * limit.mebibytes + MEBIBYTES:
                fault = f"took {cost.mebibytes:.0f} MiB instead of {limit.mebibytes:.0f} MiB"
            elif cost.seconds > 2 * limit.seconds + SECONDS:
                fault = f"took {cost.seconds:.1f} s instead of {limit.seconds:.1f} s"
        return fault, message is not None, cost

    def _command(self, name: str, path: Path) -> tuple[str | None, str]:
        """The error that a command prints, and the fault."""
        words = FORMATS[name].command.split()
        folder = self._seeds / name
        arguments = [
            each.replace("{file}", str(path))
            .replace("{folder}", str(folder))
            .replace("{out}", str(self._out))
            for each in words
        ]
        before = sys.argv
        sys.argv = ["psotrack", *arguments]
        try:
            cli.main()
        except SystemExit as stop:
            if stop.code in (0, None):
                return None, ""
            sys.stderr.flush()
            with open(2, "rb", closefd=False) as file:
                file.seek(0)
                lines = file.read().decode("utf-8", "replace").splitlines()
            if stop.code != 2 or not lines or not lines[-1].startswith("psotrack: "):
                return "", f"exit code {stop.code}, stderr {lines[-1:]}"
            return lines[-1], ""
        except BaseException as error:
            return "", _trace(error)
        finally:
            sys.argv = before
        return None, ""


def _function(read: Callable, path: Path) -> tuple[str | None, str]:
    try:
        read(path)
    except PsotrackError as error:
        return str(error), ""
    except BaseException as error:
        return "", _trace(error)
    return None, ""


def _trace(error: BaseException) -> str:
    """Kind, message and the last place in psotrack of an error that is none of psotrack's."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "psotrack" in Path(frame.filename).parts] or frames
    place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno} {ours[-1].name}"
    return f"{type(error).__name__} at {place}: {str(error)[:200]}"


def _wrong_message(message: str, path: Path, folder: Path) -> str:
    if "\n" in message or "\r" in message or not message.isprintable():
        return f"a message that is not one printable line: {message[:300]!r}"
    # The folders of the try are no part of the message that psotrack chooses.
    shown = message.replace(str(path.parent), "").replace(str(folder), "")
    if len(shown) > LONGEST:
        return f"a message of {len(shown)} characters: {shown[:300]!r}"
    if str(folder) not in message:
        return f"a message without a file: {message[:300]!r}"
    return ""


def _listing(folder: Path) -> list[tuple[str, int, int]]:
    found = []
    for root, folders, files in os.walk(folder):
        for each in (*folders, *files):
            status = os.stat(os.path.join(root, each))
            found.append((os.path.join(root, each), status.st_size, status.st_mtime_ns))
    return sorted(found)


@contextlib.contextmanager
def _captured() -> Iterator[Callable[[], str]]:
    """Take what the process writes to stdout and stderr; the function gives the text of stderr."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept, streams = (os.dup(1), os.dup(2)), (sys.stdout, sys.stderr)
    text = ""
    with (
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
        warnings.catch_warnings(record=True) as warned,
    ):
        warnings.simplefilter("always")
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        sys.stdout, sys.stderr = _STREAMS
        try:
            yield lambda: text
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            sys.stdout, sys.stderr = streams
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            os.close(kept[0])
            os.close(kept[1])
            err.seek(0)
            shown = [f"{each.filename}:{each.lineno}: {each.message}\n" for each in warned]
            text = "".join(shown) + err.read().decode("utf-8", "replace")


def _begin_memory() -> float:
    """Begin to measure the peak of the resident memory; memory now, MiB."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS:")


def _peak_memory() -> float:
    return _memory("VmHWM:")


def _memory(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1]) / 1024
    return 0.0
