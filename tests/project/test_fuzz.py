"""Damaged files of every format: a few tries of the fuzzer with a fixed seed, and all that it ever found."""

import os
from dataclasses import replace
from pathlib import Path

import archives_made
import pytest
from fuzz.formats import FORMATS
from fuzz.trial import Judge

from psotrack.errors import InputError

TESTS = Path(__file__).parents[1]
#: Number of tries per format.
TRIES = 5
#: Files that a reader once treated wrongly, in folders with the names of their formats.
FINDS = sorted(path for path in (TESTS / "data" / "fuzz").rglob("*") if path.is_file())
#: Finds that are long and regular, or the most part of another file.
MADE = {
    "tracks-json": b'{"a":' * 20_000,
    "archive-manifest": b"[" * 20_000,
    "stored-silhouettes": b'{"a":' * 20_000,
    "run-record": b"[" * 20_000,
    "grid": b"a = " + b"[" * 20_000,
    "recording.toml": b"a = " + b"[" * 20_000,
    "marker-centres": b"a = " + b"[" * 20_000,
    "dpjait-boxes": b"- " * 2_000,
    "archive": archives_made.OLD.read_bytes()[1:],
}


@pytest.fixture(scope="module")
def judges(tmp_path_factory):
    """A judge for each format, made when it is needed."""
    made = {}

    def of(name):
        if name not in made:
            made[name] = Judge(tmp_path_factory.mktemp("fuzz") / "files", 0, (name,))
        return made[name]

    return of


@pytest.mark.nightly
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused_in_one_line(name, judges):
    """`make fuzz` makes many thousands of tries."""
    judge = judges(name)
    trials = [judge.attempt(number) for number in range(1 if FORMATS[name].is_slow else TRIES)]
    assert [trial for trial in trials if trial.fault] == []
    assert FORMATS[name].is_slow or len({trial.content for trial in trials}) > TRIES // 2


@pytest.mark.nightly
def test_the_program_makes_tries(start_python):
    """Found: its processes died at their start, and the program ended with exit code 0."""
    environment = os.environ | {"PYTHONPATH": f"{TESTS.parent}:{TESTS}"}
    program = start_python("-m", "fuzz", "--tries", 3, env=environment)
    said, _ = program.communicate()
    assert said.startswith("3 tries of ")
    assert program.returncode == 0


def judged(judge, name, content):
    each = FORMATS[name]
    calls = (*each.reads, *([None] if each.command else []))
    return [judge.judge(0, name, read, content) for read in calls]


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path,
            id=f"{path.parent.name}-{path.stem}",
            marks=[pytest.mark.slow] * FORMATS[path.parent.name].is_slow,
        )
        for path in FINDS
    ],
)
def test_what_was_found_is_mended(path, judges):
    name = path.parent.name
    assert [trial for trial in judged(judges(name), name, path.read_bytes()) if trial.fault] == []


@pytest.mark.parametrize("name", MADE)
def test_brackets_in_brackets_and_a_lost_beginning_are_refused(name, judges):
    trials = judged(judges(name), name, MADE[name])
    assert [trial for trial in trials if trial.fault] == []
    assert any(trial.is_refused for trial in trials)


def test_the_judge_sees_faults(judges, monkeypatch):
    """What no reader does any more: a traceback, text on stderr, a message without the file, a file that is written."""

    def trace(path):
        raise ValueError("no")

    def forget(path):
        raise InputError("somewhere", expected="this", found="that")

    judge, sound = judges("world"), FORMATS["world"]
    for read, fault in (
        (trace, "ValueError at test_fuzz.py"),
        (lambda path: os.write(2, b"libfoo: bad\n"), "stderr: libfoo: bad"),
        (forget, "a message without a file"),
        (lambda path: (path.parent / "new").touch(), "a file beside the input"),
        (lambda path: bytearray(600 << 20), "MiB instead of"),
    ):
        # Whoever reads the sound file without a fault, and the changed one with it.
        def both(path, read=read):
            if b"changed" in path.read_bytes():
                read(path)

        monkeypatch.setitem(FORMATS, "world", replace(sound, reads=(both,)))
        judge._costs.clear()
        assert fault in judge.judge(0, "world", both, b"changed").fault
