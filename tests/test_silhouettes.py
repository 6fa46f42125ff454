"""The store of silhouettes: its content, when silhouettes are computed again, and interruptions."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.recordings import Recording, VideoWriter, probe, read_frames
from psotrack.silhouettes import Silhouettes, compute
from psotrack.silhouettes import store as silhouette_store
from psotrack.silhouettes.computation import SilhouetteSettings
from psotrack.silhouettes.foreground import coverage, foreground
from psotrack.support import Advance, map_in_processes

NUM_FRAMES = 30
SIZE_WH = (162, 118)  # no multiple of 4
SETTINGS = SilhouetteSettings(num_learning_frames=10)


def _write_video(path: Path, seed: int, num_frames: int = NUM_FRAMES) -> None:
    """Dark discs that move in front of smooth texture, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(90, 190, (5, 7, 3)).astype(np.float32)
    scene = cv2.resize(coarse, SIZE_WH, interpolation=cv2.INTER_CUBIC)
    with VideoWriter(path, 25.0, SIZE_WH) as writer:
        for index in range(num_frames):
            image = scene + rng.normal(0, 2, scene.shape)
            cv2.circle(image, (20 + 4 * index, 30 + 10 * seed), 9, (25, 25, 25), -1, cv2.LINE_AA)
            writer.write(np.clip(image, 0, 255).astype(np.uint8))


def _sequence(folder: Path) -> Recording:
    """A sequence of all videos in a folder."""
    R, t_m = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
    K = np.array([[100.0, 0, 81], [0, 100, 59], [0, 0, 1]])
    videos = {path.stem: probe(path) for path in sorted(folder.glob("*.avi"))}
    rig = make_rig({name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH) for name in videos})
    return Recording(folder.name, folder, rig, videos)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for seed in range(3):
        _write_video(folder / f"cam{seed + 1}.avi", seed)
    return folder


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    """Three videos that a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "videos"))


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the videos of all frames that are decoded in this process, in order."""
    names: list[str] = []

    def counted(video, step=1):  # type: ignore[no-untyped-def]
        for frame in read_frames(video, step):
            names.append(video.path.stem)
            yield frame

    monkeypatch.setattr(silhouette_store, "read_frames", counted)
    return names


def _expected(sequence: Recording, settings: SilhouetteSettings = SETTINGS) -> np.ndarray:
    """Silhouettes without store, workers or chunks: (frames, cameras, height, width)."""
    step = silhouette_store.learning_step(sequence.num_frames, settings)
    factor = settings.reduction // settings.working_reduction
    return np.stack(
        [
            [
                coverage(mask, factor)
                for mask in foreground(read_frames(video, step), read_frames(video), settings)
            ]
            for video in sequence.videos.values()
        ],
        axis=1,
    )


def _all(silhouettes: Silhouettes) -> np.ndarray:
    return silhouettes.read(0, silhouettes.num_frames)


def _leftovers(cache: Path) -> list[Path]:
    return list(cache.glob(".*"))


@pytest.mark.parametrize("jobs", [1, 2])
def test_silhouettes_are_those_of_the_videos(folder: Path, tmp_path: Path, jobs: int) -> None:
    sequence = _sequence(folder)
    silhouettes = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=jobs)
    assert silhouettes.cameras == ("cam1", "cam2", "cam3")
    assert silhouettes.shape == (30, 41)
    assert (silhouettes.num_frames, silhouettes.reduction) == (NUM_FRAMES, 4)
    everything = _all(silhouettes)
    assert everything.dtype == np.uint8
    assert everything.flags.c_contiguous
    np.testing.assert_array_equal(everything, _expected(sequence))
    assert everything.any(axis=(2, 3)).all(), "a disc is in every frame of every camera"
    assert _leftovers(tmp_path / "cache") == []


@pytest.mark.parametrize(("start", "stop"), [(0, 0), (0, 1), (7, 26), (24, 26), (25, 30), (30, 30)])
def test_any_part_can_be_read(recorded: Path, shared: Silhouettes, start: int, stop: int) -> None:
    part = shared.read(start, stop)
    assert part.shape == (stop - start, 3, 30, 41)
    np.testing.assert_array_equal(part, _all(shared)[start:stop])


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (5, 31), (6, 5)])
def test_frames_that_are_not_there(shared: Silhouettes, start: int, stop: int) -> None:
    with pytest.raises(SettingsError, match=f"frames: expected a part of 0 to 30, found {start} to {stop}"):
        shared.read(start, stop)


@pytest.fixture(scope="session")
def shared(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Silhouettes:
    return compute(_sequence(recorded), SETTINGS, cache=tmp_path_factory.mktemp("cache"), jobs=1)


def test_second_call_reads_without_decoding(folder: Path, tmp_path: Path, decoded: list[str]) -> None:
    first = compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert len(decoded) == 3 * (NUM_FRAMES + 10)
    assert first.seconds["decode"] > 0
    assert first.seconds["foreground"] > 0
    decoded.clear()
    second = compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert decoded == []
    assert second.seconds == {"decode": 0.0, "foreground": 0.0}
    assert second.keys == first.keys
    np.testing.assert_array_equal(_all(second), _all(first))


def test_name_and_place_of_a_video_do_not_matter(folder: Path, tmp_path: Path, decoded: list[str]) -> None:
    compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    decoded.clear()
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    (moved / "cam3.avi").rename(moved / "other.avi")
    compute(_sequence(moved), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert decoded == []


@pytest.mark.parametrize(
    "change",
    [
        {"reduction": 2},
        {"working_reduction": 1},
        {"num_learning_frames": 11},
        {"learning_rate": 0.01},
        {"var_threshold": 17.0},
        {"shadows": "drop"},
        {"shadow_weight": 0.4},
        {"min_blob_px": 33},
    ],
)
def test_every_setting_is_in_the_key(recorded: Path, change: dict[str, object]) -> None:
    video = probe(recorded / "cam1.avi")
    changed = msgspec.structs.replace(SETTINGS, **change)
    assert silhouette_store.key_of(video, changed) != silhouette_store.key_of(video, SETTINGS)


def test_no_setting_is_missing_in_the_test_above() -> None:
    changes = test_every_setting_is_in_the_key.pytestmark[0].args[1]
    assert {name for change in changes for name in change} == set(SilhouetteSettings.__struct_fields__)


def test_changed_setting_computes_anew_and_keeps_the_old(
    folder: Path, tmp_path: Path, decoded: list[str]
) -> None:
    sequence = _sequence(folder)
    first = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)
    before = _all(first)
    decoded.clear()
    changed = msgspec.structs.replace(SETTINGS, reduction=2)
    second = compute(sequence, changed, cache=tmp_path / "cache", jobs=1)
    assert len(decoded) == 3 * (NUM_FRAMES + 10)
    np.testing.assert_array_equal(_all(second), _expected(sequence, changed))
    np.testing.assert_array_equal(_all(first), before)


def test_changed_video_is_done_anew_and_it_alone(folder: Path, tmp_path: Path, decoded: list[str]) -> None:
    compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    decoded.clear()
    _write_video(folder / "cam2.avi", seed=5)
    sequence = _sequence(folder)
    silhouettes = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert set(decoded) == {"cam2"}
    np.testing.assert_array_equal(_all(silhouettes), _expected(sequence))


def test_fewer_frames_are_other_silhouettes(folder: Path, tmp_path: Path) -> None:
    sequence = _sequence(folder)
    everything = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)
    few = sequence.usable(num_frames=12)
    silhouettes = compute(few, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert silhouettes.num_frames == 12
    assert set(silhouettes.keys.values()).isdisjoint(everything.keys.values())
    np.testing.assert_array_equal(_all(silhouettes), _expected(few))


def test_two_cameras_of_one_content_are_done_once(folder: Path, tmp_path: Path, decoded: list[str]) -> None:
    shutil.copy(folder / "cam1.avi", folder / "cam2.avi")
    silhouettes = compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert len(decoded) == 2 * (NUM_FRAMES + 10)
    everything = _all(silhouettes)
    np.testing.assert_array_equal(everything[:, 0], everything[:, 1])


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_adds_up(folder: Path, tmp_path: Path, jobs: int) -> None:
    told: list[tuple[str, int]] = []
    done: list[int] = []

    @contextlib.contextmanager
    def report(description: str, total: int) -> Iterator[Advance]:
        told.append((description, total))
        yield done.append

    for _ in range(2):
        compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=jobs, report=report)
    assert told == [("silhouettes", 3 * (NUM_FRAMES + 10))], "and nothing the second time"
    assert sum(done) == 3 * (NUM_FRAMES + 10)


@pytest.mark.parametrize("damage", ["chunk", "metadata", "shape"])
def test_damaged_silhouettes_are_made_anew(folder: Path, tmp_path: Path, damage: str) -> None:
    sequence = _sequence(folder)
    first = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)
    stored = tmp_path / "cache" / first.keys["cam2"]
    if damage == "chunk":
        (stored / "c" / "1" / "0" / "0").unlink()
    elif damage == "metadata":
        (stored / "zarr.json").write_text("{")
    else:
        text = (stored / "zarr.json").read_text()
        (stored / "zarr.json").write_text(text.replace("41", "40"))
    again = compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)
    np.testing.assert_array_equal(_all(again), _expected(sequence))


def test_damage_after_opening_is_an_error_not_background(folder: Path, tmp_path: Path) -> None:
    silhouettes = compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    chunk = tmp_path / "cache" / silhouettes.keys["cam2"] / "c" / "0" / "0" / "0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 0xFF
    chunk.write_bytes(content)
    with pytest.raises(InputError, match=f"{silhouettes.keys['cam2']}: expected readable silhouettes"):
        silhouettes.read(0, 5)


# --- errors ---


@pytest.mark.parametrize("jobs", [1, 2])
def test_truncated_video_is_named_and_the_others_stay(folder: Path, tmp_path: Path, jobs: int) -> None:
    sequence = _sequence(folder)
    video = folder / "cam3.avi"
    content = video.read_bytes()
    video.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(InputError) as raised:
        compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=jobs)
    assert str(raised.value).startswith(f"{video}: expected {NUM_FRAMES} frames, found ")
    assert _leftovers(tmp_path / "cache") == []
    video.write_bytes(content)
    np.testing.assert_array_equal(
        _all(compute(sequence, SETTINGS, cache=tmp_path / "cache", jobs=1)), _expected(sequence)
    )


def test_missing_video(folder: Path, tmp_path: Path) -> None:
    sequence = _sequence(folder)
    (folder / "cam2.avi").unlink()
    with pytest.raises(InputError, match=r"cam2\.avi: expected a readable video, found No such file"):
        compute(sequence, SETTINGS, cache=tmp_path / "cache")


def test_camera_without_video(folder: Path, tmp_path: Path) -> None:
    sequence = _sequence(folder)
    videos = {name: video for name, video in sequence.videos.items() if name != "cam2"}
    with pytest.raises(InputError, match=r"expected a video for each of the cameras .* found none for cam2"):
        compute(replace(sequence, videos=videos), SETTINGS, cache=tmp_path / "cache")


def test_videos_of_different_length(folder: Path, tmp_path: Path) -> None:
    _write_video(folder / "cam2.avi", seed=1, num_frames=20)
    with pytest.raises(InputError, match=r"cam2\.avi: expected 30 frames as in cam1\.avi, found 20 frames"):
        compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache")


@pytest.mark.parametrize("reduction", [0, -4, 3, True])
def test_reductions_that_make_no_sense(reduction: int) -> None:
    with pytest.raises(SettingsError, match="reduction: expected a "):
        SilhouetteSettings(reduction=reduction)


def test_jobs_below_one(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="jobs: expected a whole number of at least 1, found 0"):
        compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=0)


def test_cache_that_is_a_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("mine")
    with pytest.raises(OutputError, match="cache: expected a folder to write to, found File exists"):
        compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert (tmp_path / "cache").read_text() == "mine"


def test_remains_of_killed_processes_go_after_a_day(folder: Path, tmp_path: Path) -> None:
    old, young = tmp_path / "cache" / ".a.1.partial", tmp_path / "cache" / ".b.2.partial"
    for remains in (old, young):
        remains.mkdir(parents=True)
        (remains / "zarr.json").write_text("{}")
    two_days_ago = time.time() - 48 * 3600
    for path in (old / "zarr.json", old):
        os.utime(path, (two_days_ago, two_days_ago))
    compute(_sequence(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert _leftovers(tmp_path / "cache") == [young]


# --- other processes ---


def _run(
    folder: Path,
    cache: Path,
    *,
    before: str = "",
    settings: str = "SETTINGS",
    fate: str = "pass",
    after_frames: int = 0,
) -> subprocess.CompletedProcess[str]:
    """A program that computes the silhouettes of a folder in two processes of its own.

    It meets its fate by itself, when so many frames were reported: a test that looked for the moment from outside might
    come too late. It has ended when nobody writes to its stderr any more, which its workers share.
    """
    program = f"""
        import contextlib, os, signal, sys
        # A test run in the background ignores SIGINT, and its children inherit this.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from pathlib import Path
        from test_silhouettes import SETTINGS, SilhouetteSettings, _sequence, compute
        {before}

        @contextlib.contextmanager
        def report(description, total):
            done = 0

            def advance(steps):
                nonlocal done
                done += steps
                if done >= {after_frames}:
                    {fate}

            advance(0)
            yield advance

        compute(
            _sequence(Path({str(folder)!r})), {settings}, cache=Path({str(cache)!r}), jobs=2, report=report
        )
    """
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        check=False,
    )


def _finished(cache: Path) -> list[str]:
    """Keys of the stored silhouettes."""
    return [path.name for path in cache.glob("[!.]*")]


# Numbers of 120 frames: for each camera, the background is learned from 10 frames, then come 30 frames; a chunk is 25.
@pytest.mark.parametrize("after_frames", [0, 1, 75, 100])
@pytest.mark.parametrize("whole_group", [False, True])
def test_killed_call_resumes(
    folder: Path, tmp_path: Path, decoded: list[str], after_frames: int, whole_group: bool
) -> None:
    cache = tmp_path / "cache"
    whom = "0" if whole_group else "os.getpid()"
    killed = _run(folder, cache, fate=f"os.kill({whom}, signal.SIGKILL)", after_frames=after_frames)
    assert killed.returncode == -signal.SIGKILL
    if not whole_group:
        # The workers noticed that their parent has ended, and removed their unfinished folders.
        assert not _leftovers(cache)
    sequence = _sequence(folder)
    keys = {name: silhouette_store.key_of(video, SETTINGS) for name, video in sequence.videos.items()}
    finished = _finished(cache)
    resumed = compute(sequence, SETTINGS, cache=cache, jobs=1)
    assert set(decoded) == {name for name, key in keys.items() if key not in finished}
    np.testing.assert_array_equal(_all(resumed), _expected(sequence))


def test_ctrl_c_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    interrupted = _run(
        folder,
        tmp_path / "cache",
        # Workers that are slow to clear up are not made to end: how long that takes is nothing to this test.
        before="from psotrack.support import processes; processes.GRACE_S = 3600",
        fate="os.kill(0, signal.SIGINT)",  # as a terminal does: to the workers too
        after_frames=1,
    )
    assert interrupted.returncode == -signal.SIGINT
    assert interrupted.stderr.count("Traceback") == 1, "the workers end without a word"
    assert _leftovers(tmp_path / "cache") == []


def test_two_calls_at_once_do_no_harm(folder: Path, tmp_path: Path, decoded: list[str]) -> None:
    cache = tmp_path / "cache"
    with ThreadPoolExecutor(2) as threads:
        both = list(threads.map(lambda _: _run(folder, cache), range(2)))
    assert [(one.returncode, one.stderr) for one in both] == [(0, "")] * 2
    assert _leftovers(cache) == []
    sequence = _sequence(folder)
    silhouettes = compute(sequence, SETTINGS, cache=cache, jobs=1)
    assert decoded == []
    np.testing.assert_array_equal(_all(silhouettes), _expected(sequence))


def test_full_disk(folder: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    before = _all(compute(_sequence(folder), SETTINGS, cache=cache, jobs=1))
    full = _run(
        folder,
        cache,
        # Files are limited to 4 kB, so writing noise fails as on a full disk. Compiled modules are not written, because
        # they would be cut off too.
        before="import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))",
        settings="SilhouetteSettings(reduction=2, min_blob_px=0, var_threshold=0.1)",
    )
    assert full.returncode == 1
    assert "OutputError" in full.stderr
    assert "expected to write silhouettes, found File too large; what was stored before" in full.stderr
    assert _leftovers(cache) == []
    assert len(_finished(cache)) == 3
    np.testing.assert_array_equal(_all(compute(_sequence(folder), SETTINGS, cache=cache, jobs=1)), before)


def test_workers_do_not_import_jax() -> None:
    program = (
        "import sys, psotrack.silhouettes.store, psotrack.support.processes; sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def _double(task: int, advance: Advance) -> int:
    if task == -1:
        os._exit(3)
    if task < 0:
        raise SettingsError("task", expected="a number of at least 0", found=f"{task}")
    advance(task)
    return 2 * task


def test_results_come_in_the_order_of_tasks() -> None:
    done: list[int] = []
    assert map_in_processes(_double, [5, 3, 4, 1], jobs=2, advance=done.append) == [10, 6, 8, 2]
    assert sorted(done) == [1, 3, 4, 5]


def test_errors_of_workers_come_as_themselves() -> None:
    with pytest.raises(SettingsError, match=r"^task: expected a number of at least 0, found -2$"):
        map_in_processes(_double, [1, -2, 3], jobs=2, advance=lambda steps: None)


def test_worker_that_dies() -> None:
    with pytest.raises(
        PsotrackError, match="a worker process: expected a result, found that the process died"
    ):
        map_in_processes(_double, [1, -1, 3], jobs=2, advance=lambda steps: None)
