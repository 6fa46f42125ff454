"""A disk that is really full, one that cannot be written, and a slow one; `test_outputs.py` needs no rights to mount.

A small file system in memory stands for the disk. Its free pages and its number of files are counted over all files
together, so that a limit meets each write of a command in turn, those of other libraries included.
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from helpers import assert_refused, content_of, make_once
from small_sweeps import all_rows, grid_file, psotrack, small_sequence, stamps

from psotrack.show.flights import find_recording

pytestmark = pytest.mark.nightly

#: Content of the files that a command is to replace.
OLDER = b"older"
PAGE_BYTES = 4096
#: Seconds of stages and of the whole run, which differ from run to run.
TIMES = re.compile(rb'("seconds": )\{[^}]*\}|("(?:real_time_factor\w*|start_s)": )[-+.e0-9]+')


class SmallDisk:
    """A file system in memory, at `place`; `filler` takes what it must not take."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.place = folder, folder / "place"

    def mount(self, *options: str) -> None:
        command = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(self.folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")

    def remount(self, *options: str) -> None:
        subprocess.run(["mount", "-o", ",".join(["remount", *options]), str(self.folder)], check=True)

    def used(self) -> tuple[int, int]:
        """Pages and files that are in use."""
        status = os.statvfs(self.folder)
        return (
            status.f_blocks - status.f_bfree
        ) * status.f_frsize // PAGE_BYTES, status.f_files - status.f_ffree

    @contextlib.contextmanager
    def room_for(self, *, pages: int = 10**5, files: int = 10**5):
        """The disk takes this many more pages and files until the block ends."""
        used_pages, used_files = self.used()
        # No limit would be 0.
        self.remount(f"size={max(1, used_pages + pages) * PAGE_BYTES}", f"nr_inodes={used_files + files}")
        try:
            yield
        finally:
            self.remount("size=1g", "nr_inodes=1000000")


@pytest.fixture
def disk(tmp_path, monkeypatch):
    """A small disk, whose folder `place` is the current folder."""
    folder = tmp_path / "disk"
    folder.mkdir()
    found = SmallDisk(folder)
    found.mount("size=1g")
    try:
        # A page that is in use, because a file system without any page has no limit.
        (folder / "filler").write_bytes(bytes(PAGE_BYTES))
        found.place.mkdir()
        monkeypatch.chdir(found.place)
        yield found
    finally:
        os.chdir(tmp_path)
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return small_sequence(tmp_path_factory)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, root):
    """Inputs of the commands, which no test changes."""

    def make(folder):
        sequence = root / "Simulated_Data" / "S01_D2_A"
        for words in (
            [*TRACK.format(root=root).split(), "--out", folder / "tracks.csv"],
            ["archive", folder / "tracks.csv", sequence, "--out", folder / "packed.psotrack"],
        ):
            done = psotrack(root, *words)
            assert done.returncode == 0, done.stderr
        grid_file(folder, [2, 3]).rename(folder / "grid.toml")

    return make_once(tmp_path_factory, "inputs_of_small_disks", make)


def contents(folder: Path) -> dict[str, bytes | None]:
    """Path of every file, hidden ones included, -> bytes without times; of a folder -> None."""
    return {name: content and TIMES.sub(rb"\1\2", content) for name, content in content_of(folder).items()}


def limits(number: int, tries: int) -> list[int]:
    """Numbers from 0 to `number` - 1: all, or some of them, with the smallest and the largest."""
    return sorted({round(i * (number - 1) / (tries - 1)) for i in range(tries)}) if number > 0 else []


def assert_says(result, *names: str) -> None:
    """One line with one of the names."""
    assert (result.code, result.err.count("\n")) == (2, 1), result
    assert any(name in result.err for name in names), result


#: The small sequence with little effort; the program is the one that `small_sequence` compiles.
TRACK = (
    "track {root}/Simulated_Data/S01_D2_A --particles 8 --iterations 2 --swarm joint --score hard --init truth "
    "--drone-size 0.5,0.5,0.2 --reduction 2 --jobs 1 --force --quiet"
)
#: Outputs, which belong together -> words of the command that writes them.
COMMANDS = {
    "tracks.csv tracks.ambiguity.csv tracks.json": f"{TRACK} --out tracks.csv",
    "tracks.parquet tracks.ambiguity.csv tracks.json": f"{TRACK} --out tracks.parquet",
    "videos.psotrack": "archive {inputs}/tracks.csv {root}/Simulated_Data/S01_D2_A --videos "
    "--out videos.psotrack --force",
    "folder": "archive {inputs}/packed.psotrack --out folder",
    "markers.csv": "onboard detect {flight}/c0.avi --frames 4 --out markers.csv --force --quiet",
    "doctor.json": "doctor {root}/Simulated_Data/S01_D2_A --json doctor.json --quiet",
}


@pytest.mark.parametrize("outputs", COMMANDS)
def test_outputs_are_whole_or_as_they_were(run_psotrack, disk, root, inputs, flight, monkeypatch, outputs):
    monkeypatch.setenv("PSOTRACK_CACHE", str(root / "cache"))
    words, names = COMMANDS[outputs].format(root=root, inputs=inputs, flight=flight).split(), outputs.split()

    def reset():
        for path in disk.place.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        if "--force" in words:
            for name in names:
                Path(name).write_bytes(OLDER)

    empty = disk.used()
    assert run_psotrack(*words).code == 0
    whole = contents(disk.place)
    pages, files = (most - least for most, least in zip(disk.used(), empty, strict=True))
    for room in [{"pages": n} for n in limits(pages, 3)] + [{"files": n} for n in limits(files, 3)]:
        reset()
        older = contents(disk.place)
        with disk.room_for(**room):
            result = run_psotrack(*words)
        assert_says(result, *names)
        assert contents(disk.place) == older, room
    assert run_psotrack(*words).code == 0
    assert contents(disk.place) == whole


#: Output folders of commands that go on where the last call has ended -> words of the command.
GO_ON = {
    "data": "simulate S01_D2_A --out data --frames 3 --scale 0.1 --jobs 1 --no-onboard --quiet",
    "cache": "detect --silhouettes {world}/flight --cache cache --jobs 1 --quiet",
    "videos": "overlay {world}/tracks.csv {world}/flight --out videos --jobs 1 --quiet",
}


@pytest.mark.parametrize("name", GO_ON)
def test_the_next_run_goes_on(run_psotrack, disk, world, monkeypatch, tmp_path, name):
    """The disk grows from call to call, and is never emptied."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    words = GO_ON[name].format(world=world).split()
    empty = disk.used()
    assert run_psotrack(*words).code == 0
    whole = contents(disk.place)
    pages, files = (most - least for most, least in zip(disk.used(), empty, strict=True))
    shutil.rmtree(disk.place / name)
    for kind, index, number in (("files", 1, files), ("pages", 0, pages)):
        for room in limits(number, 4):
            used = disk.used()[index] - empty[index]
            if room < used:
                continue
            with disk.room_for(**{kind: room - used}):
                result = run_psotrack(*words)
            assert_says(result, name)
            left = contents(disk.place)
            assert not [path for path in left if ".partial" in path], (kind, room)
            finished = {path: content for path, content in left.items() if "/." not in path and content}
            assert finished.items() <= whole.items(), (kind, room)
    assert run_psotrack(*words).code == 0
    assert contents(disk.place) == whole


def test_a_sweep_goes_on(run_psotrack, disk, root, inputs, monkeypatch):
    monkeypatch.setenv("PSOTRACK_CACHE", str(root / "cache"))
    words = ["sweep", inputs / "grid.toml", "--data", root, "--quiet", "--out"]
    assert run_psotrack(*words, "whole").code == 0
    # Until the disk takes the first cell.
    rooms = [{"files": n} for n in range(4)] + [{"pages": n} for n in range(0, 100, 3)]
    while not stamps(Path("results")):
        room = rooms.pop(0)
        with disk.room_for(**room):
            result = run_psotrack(*words, "results")
        assert_says(result, "results")
        assert not [path for path in contents(disk.place) if ".partial" in path], room
        # No cell has failed: the disk has.
        assert not list(disk.place.glob("results/cells/*.error.json")), room
    finished = stamps(Path("results"))
    assert len(finished) == 1
    assert run_psotrack(*words, "results").code == 0
    assert finished.items() < stamps(Path("results")).items(), "a finished cell is not run again"
    expected, found = (
        all_rows(Path(name)).set_index("settings.swarm.iterations").sort_index().filter(regex="error")
        for name in ("whole", "results")
    )
    assert len(expected.columns) > 0
    pd.testing.assert_frame_equal(found, expected)


def test_a_sweep_on_a_cluster_goes_on(disk, root, inputs):
    words = f"sweep {inputs}/grid.toml --data {root} --quiet --cluster local --out results".split()
    # Until a worker meets the full disk, and not the command, whose manifest takes more than two pages.
    pages, said = 2, ""
    while "results/cells" not in said and "results/_errors" not in said:
        pages += 1
        with disk.room_for(pages=pages):
            result = psotrack(root, *words)
        said = result.stderr
        assert (result.returncode, said.count("\n")) == (2, 1), said
    # Two workers may have had room for the errors of their cells, but no cell has rows.
    assert not list(disk.place.glob("results/cells/*"))
    result = psotrack(root, *words)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(stamps(Path("results"))) == 2


def test_a_demonstration_goes_on(run_psotrack, disk, monkeypatch, tmp_path):
    """Found: after a full disk, the next call refused the sequence that the first one had simulated."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("psotrack.cli.demo.NUM_FRAMES", 6)
    monkeypatch.setattr("psotrack.cli.demo.SCALE", 0.25)
    words = ["demo", "--out", "demo", "--jobs", "1", "--quiet"]
    assert run_psotrack(*words).code == 0

    def simulated():
        return {path: path.stat().st_mtime_ns for path in Path("demo/Simulated_Data").rglob("*")}

    whole, made = contents(disk.place), simulated()
    results = [
        Path("demo", name) for name in ("tracks.csv", "tracks.json", "tracks.ambiguity.csv", "demo.png")
    ]
    # Found: the demo wrote no record, so that `psotrack view demo/tracks.csv` had no cameras.
    assert find_recording(results[0]).resolve() == Path("demo/Simulated_Data/S02_D4_A").resolve()
    for pages in (0, 2, results[0].stat().st_size // PAGE_BYTES + 2):
        for path in results:
            path.unlink(missing_ok=True)
        with disk.room_for(pages=pages):
            result = run_psotrack(*words)
        assert (result.code, result.err.count("\n")) == (2, 1), (pages, result)
        assert not any(path.exists() for path in results), pages
        assert ".partial" not in "".join(contents(disk.place)), pages
    assert run_psotrack(*words).code == 0
    assert contents(disk.place) == whole
    assert simulated() == made
    for path in results:
        path.unlink()
    other = run_psotrack(*words, "--seed", 2)
    assert other.code == 2
    assert "S02_D4_A: expected a path that does not exist yet" in other.err


#: Commands with an output on a disk that cannot be written, at `out`.
READ_ONLY = [
    "track {flight} --out out/tracks.csv",
    "track {flight} --out out/tracks.csv --causal",
    "track {flight} --out tracks.csv --json out/record.json",
    "track {flight} --out tracks.csv --log out/steps.log",
    "track {flight} --out tracks.csv --save-config out/run.toml",
    "track {flight} --out tracks.csv --cache out/cache",
    "live {flight} --replay --out out/tracks.csv",
    "sweep {inputs}/grid.toml --data {root} --out out/results",
    "simulate S01_D2_A --out out/data",
    "detect --silhouettes {flight} --cache out/cache",
    "detect {flight} --masks out/masks",
    "detect {flight} --blobs --out out/boxes",
    "simulate labels {flight} {world}/second --drone-size 0.3,0.3,0.15 --out out/yolo",
    "overlay {world}/tracks.csv {flight} --out out/videos",
    "report {world}/tracks.csv {flight} --out out/page.html",
    "evaluate {world}/tracks.csv {flight} --plot out/errors.png",
    "export {world}/tracks.csv --to tum --out out/tum",
    "archive {world}/tracks.csv {flight} --out out/flight.psotrack",
    "doctor {flight} --detections blobs --json out/doctor.json",
]


def test_a_disk_that_cannot_be_written_is_named_before_the_work(
    run_psotrack, disk, root, inputs, world, tmp_path, monkeypatch
):
    """Neither silhouettes nor tracks are computed."""
    (tmp_path / "here").mkdir()
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path / "here")
    Path("out").symlink_to(disk.place)
    disk.remount("ro")
    for command in READ_ONLY:
        words = command.format(flight=world / "flight", world=world, root=root, inputs=inputs).split()
        assert_refused(lambda words=words: run_psotrack(*words), "psotrack: out/", unchanged=tmp_path)


def test_a_cache_that_cannot_be_written_is_read(run_psotrack, disk, root, tmp_path, monkeypatch):
    shutil.copytree(root / "cache", "cache")
    monkeypatch.setenv("PSOTRACK_CACHE", str(disk.place / "cache"))
    disk.remount("ro")
    words = TRACK.format(root=root).split()
    result = run_psotrack(*words, "--out", tmp_path / "tracks.csv")
    assert (result.code, result.err) == (0, "")
    monkeypatch.setenv("PSOTRACK_CACHE", str(root / "cache"))
    assert run_psotrack(*words, "--out", tmp_path / "again.csv").code == 0
    assert (tmp_path / "tracks.csv").read_bytes() == (tmp_path / "again.csv").read_bytes()


#: `psotrack` on a slow disk: each file of the stored silhouettes takes this long.
SLOW = """
import time
from pathlib import Path
write = Path.write_bytes
def write_slowly(*words):
    time.sleep(0.3)
    return write(*words)
Path.write_bytes = write_slowly
from psotrack.cli import main
main()
"""


def test_two_processes_make_silhouettes_on_a_slow_disk(run_psotrack, flight, tmp_path):
    words = ["detect", "--silhouettes", str(flight), "--jobs", "1", "--quiet", "--cache"]
    both = [
        subprocess.Popen(
            [sys.executable, "-c", SLOW, *words, str(tmp_path / "slow")],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    said = [process.communicate(timeout=120) for process in both]
    assert [(process.returncode, *words) for process, words in zip(both, said, strict=True)] == [
        (0, "", "")
    ] * 2
    assert run_psotrack(*words, tmp_path / "quick").code == 0
    assert contents(tmp_path / "slow") == contents(tmp_path / "quick")
