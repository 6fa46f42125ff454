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
from typing import NamedTuple

from fuzz.formats import FORMATS, make_all
from fuzz.mutations import mutate
from psotrack import cli
from psotrack.errors import PsotrackError

#: Longest message, characters; the folders of the tries do not count.
LONGEST = 300
#: What a try may take beside twice what the sound file takes; and where a command accepts a file, whose arrays may have
#: another shape, for which programs are compiled.
SECONDS, MEBIBYTES, COMPILING_SECONDS = 2.0, 256, 8.0
#: Share of the tries that run a command.
COMMANDS = 0.05


#: Stream of Python to the file descriptor, whatever else pytest has made of `sys.stderr`.
_STDERR = open(2, "w", closefd=False)  # noqa: SIM115


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


class _Cost(NamedTuple):
    seconds: float
    mebibytes: float


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
        """The fault, whether the file was refused, and the cost."""
        folder = self._seeds / name
        shutil.rmtree(self._out, ignore_errors=True)
        self._out.mkdir()
        before = _listing(folder)
        held = _begin_memory()
        began_s = time.process_time()
        with _captured() as said:
            message, fault = self._command(name, path) if read is None else _function(read, path)
        cost = _Cost(time.process_time() - began_s, _memory("VmHWM:") - held)
        lines = said().splitlines()
        is_refused = message is not None
        if read is None:
            if is_refused:
                message = lines.pop() if lines else ""
                if not message.startswith("psotrack: "):
                    fault = fault or f"stderr ends with {message!r}"
            lines = [line for line in lines if not line.startswith("psotrack: warning: ")]
        faults = [fault]
        if is_refused:
            faults.append(_wrong_message(message, path, folder))
        if lines:
            faults.append(f"stderr: {lines[0][:300]}")
        if _listing(folder) != before:
            faults.append("a file beside the input was written or changed")
        if is_refused and any(self._out.iterdir()):
            faults.append(f"written in spite of the error: {sorted(self._out.rglob('*'))[:3]}")
        # Memory first: where the machine has little of it, it also takes time.
        if limit is not None and cost.mebibytes > 2 * limit.mebibytes + MEBIBYTES:
            faults.append(f"took {cost.mebibytes:.0f} MiB instead of {limit.mebibytes:.0f} MiB")
        more_s = COMPILING_SECONDS if read is None and not is_refused else SECONDS
        if limit is not None and cost.seconds > 2 * limit.seconds + more_s:
            faults.append(f"took {cost.seconds:.1f} s instead of {limit.seconds:.1f} s")
        return next(filter(None, faults), ""), is_refused, cost

    def _command(self, name: str, path: Path) -> tuple[str | None, str]:
        """A text where a command refuses the file, whose message is on stderr; and the fault."""
        places = {"{file}": path, "{folder}": self._seeds / name, "{out}": self._out}
        words = ["psotrack"]
        for word in FORMATS[name].command.split():
            for place, whole in places.items():
                word = word.replace(place, str(whole))
            words.append(word)
        before = sys.argv
        sys.argv = words
        try:
            cli.main()
        except SystemExit as stop:
            if stop.code in (0, None):
                return None, ""
            return "", "" if stop.code == 2 else f"exit code {stop.code}"
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


def _listing(folder: Path) -> list[tuple[Path, int, int]]:
    found = []
    for path in folder.rglob("*"):
        status = path.stat()
        found.append((path, status.st_size, status.st_mtime_ns))
    return sorted(found)


@contextlib.contextmanager
def _captured() -> Iterator[Callable[[], str]]:
    """Take what the process writes to stderr, libraries included; the function gives the text."""
    kept, stream = os.dup(2), sys.stderr
    text = ""
    with tempfile.TemporaryFile() as file, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        stream.flush()
        os.dup2(file.fileno(), 2)
        sys.stderr = _STDERR
        try:
            yield lambda: text
        finally:
            _STDERR.flush()
            sys.stderr = stream
            os.dup2(kept, 2)
            os.close(kept)
            for each in warned:
                text += f"{each.filename}:{each.lineno}: {each.message}\n"
            file.seek(0)
            text += file.read().decode("utf-8", "replace")


def _begin_memory() -> float:
    """Begin to measure the peak of the resident memory; memory now, MiB."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS:")


def _memory(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1]) / 1024
    return 0.0
