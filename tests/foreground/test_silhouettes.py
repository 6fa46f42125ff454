"""Silhouettes: their settings, the store and the cache, frames that are left out, and blobs."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from helpers import Output, assert_refused, cameras_of, make_once, with_cameras
from hypothesis import given, settings
from hypothesis import strategies as st
from worker_tasks import double

from psotrack.errors import InputError, PsotrackError
from psotrack.foreground.silhouettes import (
    SEAL_FILE,
    ForegroundSettings,
    Living,
    Mog2,
    Silhouettes,
    SilhouetteSettings,
    blob_detections,
    border_cells,
    computation,
    compute,
    coverage,
    find_blobs,
    foreground_is_everywhere,
    is_whole,
    learning_step,
    list_entries,
    look_first,
    stored_silhouettes,
    usual_drone_px,
)
from psotrack.foreground.silhouettes import store as silhouette_store
from psotrack.foreground.silhouettes.usable_frames import LEAST_FRAMES, in_words, intervals_of
from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.recordings import (
    FrameTimes,
    Recording,
    TruncatedVideoError,
    VideoWriter,
    probe,
    probe_silhouettes,
    read_frames,
)
from psotrack.support import Advance, atomic_write, map_in_processes

NUM_FRAMES = 30
SIZE_WH = (162, 118)  # not multiples of 4
SETTINGS = SilhouetteSettings(
    background="mog2", reduction=4, working_reduction=2, min_blob_px=64, num_learning_frames=10
)
#: Frames of a longer video, and those in which its camera shows another picture in each frame.
NUM_USABLE, SHAKEN = 80, range(40, 55)


def _write_video(path: Path, seed: int, num_frames: int = NUM_FRAMES, shaken: range = range(0)) -> None:
    """A video of a dark disc that moves in front of a smooth texture, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(90, 190, (5, 7, 3)).astype(np.float32)
    background = cv2.resize(coarse, SIZE_WH, interpolation=cv2.INTER_CUBIC)
    with VideoWriter(path, 25.0, SIZE_WH) as writer:
        for index in range(num_frames):
            image = background + rng.normal(0, 2, background.shape)
            if index in shaken:
                image = cv2.resize(rng.uniform(0, 255, (12, 16, 3)), SIZE_WH)
            x = 20 + 120 * index // num_frames
            cv2.circle(image, (x, 30 + 10 * seed), 9, (25, 25, 25), -1, cv2.LINE_AA)
            writer.write(np.clip(image, 0, 255).astype(np.uint8))


def _make_recording(folder: Path) -> Recording:
    """A recording of all videos in a folder."""
    R, t_m = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
    K = np.array([[100.0, 0, 81], [0, 100, 59], [0, 0, 1]])
    videos = {path.stem: probe(path) for path in sorted(folder.glob("*.avi"))}
    rig = make_rig({name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH) for name in videos})
    return Recording(folder.name, folder, cameras_of(rig, video=videos))


def _make_videos(folder: Path) -> None:
    for seed in range(3):
        _write_video(folder / f"cam{seed + 1}.avi", seed)


@pytest.fixture(scope="session")
def video_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_once(tmp_path_factory, "three_videos", _make_videos)


@pytest.fixture
def folder(video_folder: Path, tmp_path: Path) -> Path:
    """Folder with three videos that a test may change."""
    return Path(shutil.copytree(video_folder, tmp_path / "videos"))


@pytest.fixture
def recording(folder: Path) -> Recording:
    return _make_recording(folder)


@pytest.fixture
def decoded() -> list[int]:
    """Gets the numbers of frames that `make` decodes, in this process and in others."""
    return []


@pytest.fixture
def make(tmp_path: Path, decoded: list[int]) -> Callable[..., Silhouettes]:
    """Computes the silhouettes of a recording in this process, into the cache of the test."""

    @contextlib.contextmanager
    def report(description: str, total: int) -> Iterator[Advance]:
        before = sum(decoded)
        yield decoded.append
        assert (description, total) == ("silhouettes", sum(decoded) - before)

    return functools.partial(compute, settings=SETTINGS, cache=tmp_path / "cache", jobs=1, report=report)


def _expected(recording: Recording, settings: SilhouetteSettings = SETTINGS) -> np.ndarray:
    """Silhouettes without store, workers or chunks, (frames, cameras, height, width)."""
    scaled = settings.scaled([video.image_size_wh for video in recording.videos.values()])
    step = learning_step(recording.num_frames, scaled)
    factor = scaled.reduction // scaled.working_reduction
    return np.stack(
        [
            [
                coverage(mask, factor)
                for mask in Mog2(scaled).foreground(read_frames(video, step), read_frames(video))
            ]
            for video in recording.videos.values()
        ],
        axis=1,
    )


def _read_all(silhouettes: Silhouettes) -> np.ndarray:
    return silhouettes.read(0, silhouettes.num_frames)


def _keys(recording: Recording, settings: SilhouetteSettings = SETTINGS) -> dict[str, str]:
    return {name: each.key for name, each in stored_silhouettes(recording, settings, Path()).items()}


def _damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def _warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


# --- settings


@pytest.mark.parametrize(
    ("settings", "sizes_wh", "usual_px", "expected"),
    [
        ({}, [(640, 512), (1920, 1080)], None, (2, 4, 9)),
        ({}, [(3840, 2160)], None, (4, 8, 9)),
        ({}, [(120, 160)], None, (1, 1, 9)),
        ({"background": "mog2"}, [(1920, 1080)], None, (2, 4, 64)),
        ({"drone_px": 12.0}, [(3840, 2160)], None, (1, 2, 6)),
        ({"drone_px": 5.0}, [(3840, 2160)], None, (1, 1, 4)),
        ({"reduction": 3}, [(1920, 1080)], None, (1, 3, 9)),
        ({"working_reduction": 3}, [(1920, 1080)], None, (3, 6, 9)),
        ({"min_blob_px": 0}, [(1920, 1080)], None, (2, 4, 0)),
        # A drone of 24 px is six stored values of 4 px wide: the background model needs no finer image.
        ({}, [(1920, 1080)], 24.0, (4, 4, 9)),
        ({}, [(1920, 1080)], 23.0, (2, 4, 9)),
        ({"drone_px": 40.0}, [(1920, 1080)], 500.0, (2, 4, 64)),
        ({"working_reduction": 1}, [(1920, 1080)], 500.0, (1, 2, 9)),
    ],
)
def test_reductions_and_smallest_blob_follow_from_the_drones_size(
    settings: dict[str, Any],
    sizes_wh: list[tuple[int, int]],
    usual_px: float | None,
    expected: tuple[int, int, int],
) -> None:
    scaled = SilhouetteSettings(**settings).scaled(sizes_wh, usual_px)
    assert (scaled.working_reduction, scaled.reduction, scaled.min_blob_px) == expected


def test_the_usual_width_of_a_drone_follows_from_the_rig() -> None:
    K = np.array([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
    cameras = {}
    for name, eye in (("a", (6.0, 0.0, 1.0)), ("b", (0.0, 3.0, 1.0))):
        R, t_m = look_at(eye, (0.0, 0.0, 1.0))
        cameras[name] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    # 0.3 m at 6 m, in the farther camera.
    assert usual_drone_px(make_rig(cameras)) == pytest.approx(50.0)
    assert usual_drone_px(make_rig({"a": cameras["a"]})) is None


def test_every_setting_the_model_and_the_number_of_frames_are_in_the_key(video_folder: Path) -> None:
    changes: list[dict[str, Any]] = [
        {"reduction": 2},
        {"working_reduction": 1},
        {"num_learning_frames": 11},
        {"learning_rate": 0.01},
        {"var_threshold": 17.0},
        {"shadows": "drop"},
        {"shadow_weight": 0.4},
        {"min_blob_px": 33},
        {"background": "living"},
        {"background": "living", "first_look": False},
    ]
    assert {name for change in changes for name in change} >= set(ForegroundSettings.__struct_fields__)
    recording = _make_recording(video_folder)
    keys = [
        _keys(recording, msgspec.structs.replace(SETTINGS, **change))["cam1"] for change in [{}, *changes]
    ]
    keys += [_keys(recording.usable(num_frames=12))["cam1"]]
    assert len(set(keys)) == len(keys)


# --- the store


def test_stored_silhouettes_equal_direct_computation(recording: Recording, make, decoded: list[int]) -> None:
    for _ in range(2):
        silhouettes = make(recording)
    assert sum(decoded) == 3 * (NUM_FRAMES + 10), "the second call decodes nothing"
    assert silhouettes.cameras == ("cam1", "cam2", "cam3")
    assert silhouettes.shape == (30, 41)
    assert (silhouettes.num_frames, silhouettes.reduction) == (NUM_FRAMES, 4)
    assert silhouettes.keys == _keys(recording)
    all_frames = _read_all(silhouettes)
    assert all_frames.dtype == np.uint8
    assert all_frames.flags.c_contiguous
    np.testing.assert_array_equal(all_frames, _expected(recording))
    assert all_frames.any(axis=(2, 3)).all(), "every frame of every camera shows a disc"
    for start, stop in [(0, 0), (0, 1), (7, 26), (24, 26), (25, 30), (30, 30)]:
        np.testing.assert_array_equal(silhouettes.read(start, stop), all_frames[start:stop])
    for start, stop in [(-1, 5), (5, 31), (6, 5)]:
        words = f"expected a part of 0 to 30, found {start} to {stop}"
        assert_refused(functools.partial(silhouettes.read, start, stop), words, unchanged=recording.folder)


def test_silhouettes_of_the_living_background_equal_those_of_frames_that_are_kept(
    recording: Recording, make
) -> None:
    """The store decodes each frame over the one before; here all frames are kept."""
    settings = SilhouetteSettings(background="living", reduction=4, working_reduction=2, min_blob_px=64)
    silhouettes = make(recording, settings=settings)
    scaled = settings.scaled([SIZE_WH])
    for camera, video in enumerate(recording.videos.values()):
        looked_at = look_first(video, iter(list(read_frames(video))), scaled)
        masks = [coverage(mask, 2) for mask in Living(scaled).masks(*looked_at)]
        assert np.any(masks)
        np.testing.assert_array_equal(_read_all(silhouettes)[:, camera], masks)


def test_only_what_is_missing_is_decoded(folder: Path, tmp_path: Path, make, decoded: list[int]) -> None:
    shutil.copy(folder / "cam1.avi", folder / "cam2.avi")
    first = make(_make_recording(folder))
    assert sum(decoded) == 2 * (NUM_FRAMES + 10), "equal videos are decoded once"
    assert min(first.seconds["decode"], first.seconds["foreground"]) > 0
    before = _read_all(first)
    np.testing.assert_array_equal(before[:, 0], before[:, 1])
    decoded.clear()
    # Name and folder of a video are not in the key.
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    (moved / "cam3.avi").rename(moved / "other.avi")
    second = make(_make_recording(moved))
    assert decoded == []
    assert second.seconds == {"decode": 0.0, "foreground": 0.0}
    np.testing.assert_array_equal(_read_all(second), before)
    # Fewer frames are made anew. What happens to the folder has no effect after reading.
    shorter = _make_recording(folder).usable(["cam3"], num_frames=12)
    np.testing.assert_array_equal(_read_all(make(shorter)), _expected(shorter))
    # The background is learned from every other frame.
    assert sum(decoded) == 12 + 6
    shutil.rmtree(tmp_path / "cache")
    np.testing.assert_array_equal(_read_all(first), before)


def test_silhouettes_that_are_stored_meanwhile_stay(recording: Recording, tmp_path: Path) -> None:
    """A process that reads a whole folder would find no files while the folder is replaced."""
    task = computation.tasks_of(recording, SETTINGS, tmp_path)["cam1"]
    silhouette_store.store(task, lambda steps: None)
    before = task.stored.path.stat().st_ino
    silhouette_store.store(task, lambda steps: None)
    assert task.stored.path.stat().st_ino == before
    assert is_whole(task.stored.path)
    assert list(tmp_path.glob(".*")) == []


@pytest.fixture(scope="module")
def whole(video_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of stored silhouettes."""
    recording = _make_recording(video_folder).usable(["cam1"])
    silhouettes = compute(recording, SETTINGS, cache=tmp_path_factory.mktemp("whole"), jobs=1)
    return next(tmp_path_factory.getbasetemp().glob(f"whole*/{silhouettes.keys['cam1']}"))


@settings(max_examples=20)
@given(data=st.data())
def test_no_changed_bit_and_no_truncation_goes_unnoticed(whole: Path, data: st.DataObject) -> None:
    """Whole folders pass, and a folder with one changed bit or a file cut short does not."""
    assert is_whole(whole)
    file = data.draw(st.sampled_from(sorted(path for path in whole.rglob("*") if path.is_file())))
    content = file.read_bytes()
    damaged = bytearray(content)
    if data.draw(st.booleans()):
        damaged[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    else:
        del damaged[data.draw(st.integers(0, len(content) - 1)) :]
    try:
        file.write_bytes(damaged)
        assert not is_whole(whole)
    finally:
        file.write_bytes(content)


@pytest.mark.parametrize(
    ("file", "how", "brought"),
    [("c/0/0/0", _damage, True), ("c/0/0/0", Path.unlink, False), ("zarr.json", _damage, False)],
)
def test_damage_is_named_and_the_silhouettes_are_made_anew(
    recording: Recording, tmp_path: Path, make, file: str, how, brought: bool, caplog
) -> None:
    """Also where the recording itself brings the silhouettes, as an archive does."""
    stored = tmp_path / "cache" / make(recording).keys["cam2"]
    if brought:
        own = stored.rename(tmp_path / "own")
        recording = with_cameras(recording, silhouettes={"cam2": probe_silhouettes(own)})
        make(recording)
        assert not stored.exists()
        stored = own
    how(stored / file)
    caplog.clear()
    again = make(recording)
    assert _warnings(caplog) == [f"{stored}: damaged silhouettes; they are made anew"]
    np.testing.assert_array_equal(_read_all(again), _expected(recording))


def test_a_truncated_video_is_named_and_the_other_videos_are_kept(
    recording: Recording, tmp_path: Path, make, decoded: list[int]
) -> None:
    """`--frames` counts instants at the rate of the fastest camera, not frames of the truncated video."""
    recording = with_cameras(recording, times={"cam3": FrameTimes(NUM_FRAMES, fps=12.5)})
    video = recording.videos["cam3"].path
    os.truncate(video, video.stat().st_size * 2 // 3)
    found = []
    for jobs in (2, 1):
        with pytest.raises(TruncatedVideoError) as error_info:
            make(recording, jobs=jobs)
        assert str(error_info.value).startswith(f"{video}: expected {NUM_FRAMES} frames, found ")
        found.append((error_info.value.num_readable, error_info.value.num_instants))
    assert list((tmp_path / "cache").glob(".*")) == []
    decoded.clear()
    others = recording.usable(["cam1", "cam2"])
    np.testing.assert_array_equal(_read_all(make(others)), _expected(others))
    assert decoded == []
    # The commands with `--frames` advise this number.
    (readable, advised), other = found
    assert other == (readable, advised)
    # Frame i of the slow camera is nearest to instants 2i - 1 (or 2i - 1 and 2i) to 2i + 1.
    assert 2 * readable - 1 <= advised <= 2 * readable
    make(recording.usable(num_frames=advised))
    with pytest.raises(InputError, match="can be decoded"):
        make(recording.usable(num_frames=advised + 1))


def test_a_camera_without_video_sees_nothing_where_not_all_need_one(recording: Recording, make) -> None:
    made = make(with_cameras(recording, video={"cam2": None}), all_videos=False)
    assert made.cameras == ("cam1", "cam2", "cam3")
    assert set(made.keys) == {"cam1", "cam3"}
    shown = made.at_instants(recording.timeline())
    assert shown.exposures is not None
    assert shown.exposures.is_there.all(axis=0).tolist() == [True, False, True]
    assert shown.exposures.is_there.any(axis=0).tolist() == [True, False, True]
    expected = _read_all(make(recording))
    expected[:, 1] = 0
    np.testing.assert_array_equal(_read_all(shown), expected)


def test_cameras_of_different_size_and_length_are_filled_up_with_background(folder: Path, make) -> None:
    with VideoWriter(folder / "cam2.avi", 25.0, (202, 98)) as writer:
        for frame in itertools.islice(read_frames(probe(folder / "cam1.avi")), 20):
            writer.write(cv2.copyMakeBorder(frame[20:], 0, 0, 0, 40, cv2.BORDER_REPLICATE))
    recording = _make_recording(folder)
    recording.by_name["cam2"].camera.image_size_wh[:] = (202, 98)
    silhouettes = make(recording)
    assert silhouettes.shape == (30, 51)
    expected = np.zeros((NUM_FRAMES, 3, 30, 51), np.uint8)
    for index, name in enumerate(recording.rig.names):
        alone = _expected(recording.usable([name]))[:, 0]
        assert alone.any()
        num_frames, height, width = alone.shape
        expected[:num_frames, index, :height, :width] = alone
    np.testing.assert_array_equal(_read_all(silhouettes), expected)


def test_what_is_ignored_is_background_and_belongs_to_the_key(
    recording: Recording, tmp_path: Path, make
) -> None:
    white = np.zeros(SIZE_WH[::-1], np.uint8)
    white[:, :81] = 255
    cv2.imwrite(str(tmp_path / "left.png"), white)
    plain, without = make(recording), make(with_cameras(recording, ignore={"cam1": tmp_path / "left.png"}))
    assert {name for name in plain.keys if plain.keys[name] != without.keys[name]} == {"cam1"}
    before, after = _read_all(plain), _read_all(without)
    # Working pixels are 2 x 2: pixel 40 covers columns 80 and 81, of which one is ignored.
    assert before[:, 0, :, :20].any()
    assert not after[:, 0, :, :20].any()
    np.testing.assert_array_equal(after[:, 0, :, 21:], before[:, 0, :, 21:])
    np.testing.assert_array_equal(after[:, 1:], before[:, 1:])


def _ignoring(recording: Recording) -> Recording:
    cv2.imwrite(str(recording.folder / "small.png"), np.zeros((10, 10), np.uint8))
    return with_cameras(recording, ignore={"cam1": recording.folder / "small.png"})


def _without_file(recording: Recording) -> Recording:
    recording.videos["cam2"].path.unlink()
    return recording


def _settings(kind: type = SilhouetteSettings, **settings: Any) -> Callable[..., Callable[[], object]]:
    return lambda recording, make: functools.partial(kind, **settings)


def _made(change: Callable[[Recording], Recording], **options: Any) -> Callable[..., Callable[[], object]]:
    return lambda recording, make: functools.partial(make, change(recording), **options)


#: Name of the case -> what makes the bad call from a recording and `make`, and words of the line.
BAD = {
    "no rate": (
        _settings(learning_rate=float("nan")),
        "learning_rate: expected a number of at least 0, found NaN",
    ),
    "no multiple": (
        _settings(ForegroundSettings, reduction=3, working_reduction=2),
        "reduction: expected a multiple of working_reduction, 2, found 3",
    ),
    "unused": (
        _settings(shadows="drop"),
        "shadows: expected keep, because the background model living does not",
    ),
    "no jobs": (_made(lambda recording: recording, jobs=0), "jobs: expected a whole number of at least 1"),
    "small mask": (_made(_ignoring), "small.png: expected 162 x 118 ", " as in cam1.avi, found 10 x 10"),
    "no video": (
        _made(lambda recording: with_cameras(recording, video={"cam2": None})),
        "expected a video for each of the cameras ",
        " found none for cam2",
    ),
    "no videos": (
        _made(
            lambda recording: with_cameras(recording, video=dict.fromkeys(recording.videos)), all_videos=False
        ),
        "expected at least one video, found none",
    ),
    "no file": (_made(_without_file), "cam2.avi: expected a readable video, found No such file"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_missing_or_wrong_is_named(case: str, recording: Recording, make) -> None:
    bad, *words = BAD[case]
    assert_refused(bad(recording, make), *words, unchanged=recording.folder)


# --- other processes


def test_results_come_in_the_order_of_tasks_and_a_process_that_dies_is_said() -> None:
    done: list[int] = []
    assert map_in_processes(double, [5, 3, 4, 1], jobs=2, advance=done.append) == [10, 6, 8, 2]
    assert sorted(done) == [1, 3, 4, 5]
    died = "a worker process: expected a result, found that the process died"
    with pytest.raises(PsotrackError, match=died):
        map_in_processes(double, [1, -1, 3], jobs=2, advance=done.append)


def test_workers_do_not_import_jax() -> None:
    program = (
        "import sys, psotrack.foreground.silhouettes.store, psotrack.support.processes;"
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


# --- the command `cache`


def test_entries_are_listed_and_pruned_the_oldest_first_and_what_is_no_entry_stays(
    run_psotrack: Callable[..., Output], recording: Recording, tmp_path: Path, make
) -> None:
    cache = tmp_path / "cache"
    command = functools.partial(run_psotrack, "cache", "--cache", cache)

    def listed() -> list[tuple[str, str, int]]:
        entries = json.loads(command("--json", "-").out)["entries"]
        return [(entry["kind"], entry["video"], round(entry["days_unused"])) for entry in entries]

    made = make(recording.usable(["cam1", "cam2"]))
    now_s, day_s = time.time(), 24 * 3600
    for seal in cache.glob(f"*/{SEAL_FILE}"):
        os.utime(seal, (now_s - 40 * day_s,) * 2)
    make(recording.usable(["cam2"]))
    program = cache / "compiled" / f"jit__scores-{'a' * 64}-cache"
    kept = cache / "compiled" / "notes-cache", cache / ("c" * 40) / "thesis.txt"
    for path in (*kept, program):
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine, or a program")
    os.utime(program, (now_s + 60,) * 2)  # used last
    (tmp_path / "elsewhere").mkdir()
    (cache / ("d" * 40)).symlink_to(tmp_path / "elsewhere")
    assert listed() == [("silhouettes", "cam1.avi", 40), ("silhouettes", "cam2.avi", 0), ("program", "", 0)]
    shown = command().out
    assert "cam1.avi" in shown
    assert "silhouettes of 2 videos, 1 programs" in shown
    assert "removed: silhouettes of 1 videos" in command("--older-than", 30).out
    assert [video for _, video, _ in listed()] == ["cam2.avi", ""]
    command("--max-gb", 1e-6)
    assert [kind for kind, _, _ in listed()] == ["program"]
    # Found: what a killed run left stayed for ever unless the same key was made again.
    with atomic_write(cache / ("e" * 40)) as used:
        # No process has this number.
        left = used.with_name(used.name.replace(f"-{os.getpid()}-", f"-{2**30}-"))
        for part in (left, used):
            (part / "c" / "0").mkdir(parents=True)
            (part / "zarr.json").write_text("{}")
        assert f"{left}" in command("--json", "-").out
        command("--empty")
        assert list_entries(cache) == []
        assert {path.name for path in cache.iterdir()} == {"compiled", "c" * 40, "d" * 40, used.name}
    assert all(path.exists() for path in kept)
    assert made.read(0, 12).any(), "a process that has read the silhouettes goes on"
    missing = functools.partial(run_psotrack, "cache", "--cache", cache / "none")
    words = f"{cache / 'none'}: expected a cache folder, found no such file or directory"
    assert_refused(missing, words, unchanged=cache)


# --- frames that are left out


def test_foreground_is_everywhere_where_most_parts_of_the_image_have_some() -> None:
    speckle = np.zeros((5, 90, 160), np.uint8)
    speckle[1, 5::10, 5::10] = 255  # a cell in each part
    speckle[2, :60, :50] = 255  # a large object
    speckle[3, 15::20, 5::10] = 255  # less than half of the parts
    # Ten drones, each where four parts of the image meet.
    for x, y in itertools.product(range(10, 160, 30), (20, 60)):
        speckle[4, y - 5 : y + 5, x - 5 : x + 5] = 255
    assert foreground_is_everywhere(speckle).tolist() == [False, True, False, False, False]


@given(st.lists(st.booleans(), max_size=60))
def test_intervals_are_the_chosen_frames(chosen: list[bool]) -> None:
    again = np.zeros(len(chosen), bool)
    intervals = intervals_of(np.array(chosen, bool))
    for start, stop in intervals:
        assert start < stop
        assert not again[max(start - 1, 0) : stop].any()
        again[start:stop] = True
    assert again.tolist() == chosen
    # Found: single key frames of a codec were left out in all cameras at once, and tracks were lost there.
    long = [each for each in intervals if each[1] - each[0] >= LEAST_FRAMES]
    assert intervals_of(np.array(chosen, bool), LEAST_FRAMES) == long
    # In words, short gaps are left out.
    assert in_words([(3, 4), (10, 20), (22, 31), (60, 70)], gap_frames=25) == "3 to 30, 60 to 69"
    assert in_words([(3, 4), (40, 41)], gap_frames=25) == "3, 40"


def test_a_camera_is_left_out_for_as_long_and_a_line_says_which_and_when(
    tmp_path: Path, make, caplog: pytest.LogCaptureFixture
) -> None:
    _write_video(tmp_path / "calm.avi", 0, NUM_USABLE)
    _write_video(tmp_path / "shaken.avi", 1, NUM_USABLE, SHAKEN)
    recording = _make_recording(tmp_path)
    for _ in range(2):  # computed, and read from the store
        caplog.clear()
        made = make(recording)
        (line,) = _warnings(caplog)
        assert line.startswith("camera shaken: 15 of 80 frames are left out")
        assert "frames 40 to 54" in line
        assert made.left_out == {"shaken": [(40, 55)]}
    frames = _read_all(made)
    assert not frames[40:55, 1].any()
    assert frames[:, 0].any(axis=(1, 2)).all()
    # The camera has no frame at these instants, and no blob.
    timeline = recording.timeline()
    there = np.ones((NUM_USABLE, 2), bool)
    there[SHAKEN, 1] = False
    every, some = (made.at_instants(each) for each in (timeline, timeline.part(np.arange(50, NUM_USABLE))))
    for shown, start in ((every, 0), (some, 50), (every.part(50, NUM_USABLE), 50)):
        assert shown.exposures is not None
        np.testing.assert_array_equal(shown.exposures.is_there, there[start:])
        np.testing.assert_array_equal(_read_all(shown), frames[start:])
    boxes = blob_detections(made, np.array([SIZE_WH, SIZE_WH], float))
    assert set(boxes["shaken"].frame.tolist()) == set(range(NUM_USABLE)) - set(SHAKEN)


# --- blobs


def test_blobs_by_hand() -> None:
    """Cells of 4 x 4 px: the middle of a box of cells, with pixel centres at whole numbers."""
    image = np.zeros((20, 30), np.uint8)
    image[4:8, 10:16] = 255
    image[12:16, 27:30] = 255
    image[15, 3] = 255  # a single cell is noise
    image[0:3, 0:9] = 20  # hardly covered
    image[10, 3:5] = 255  # two cells are a blob
    blobs = find_blobs(image, 4)
    assert blobs.centre_px.tolist() == [[51.5, 23.5], [113.5, 55.5], [15.5, 41.5]]
    assert blobs.size_px.tolist() == [[24, 16], [12, 16], [8, 4]]
    assert blobs.whole.tolist() == [True, False, True]
    # The same image in an array that a larger image of another camera needs.
    filled_up = np.pad(image, ((0, 10), (0, 10)))
    assert find_blobs(filled_up, 4).whole.tolist() == [True, True, True]
    border = border_cells(np.array([118.0, 80.0]), 4)
    assert find_blobs(filled_up, 4, border).whole.tolist() == [True, False, True]


def test_all_blobs_of_a_silhouette_count_from_large_to_small() -> None:
    """An image has 70 blobs of increasing width. Regression: only the 50 largest counted, without a word."""
    image = np.zeros((70 * 5 + 4, 90), np.uint8)
    for row in range(70):
        image[5 * row + 4 : 5 * row + 6, 4 : 6 + row] = 255
    assert (find_blobs(image, 3).size_px[:, 0] / 3).tolist() == list(range(71, 1, -1))


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_blobs_do_not_depend_on_the_pixels_per_cell(seed: int, times: int) -> None:
    """Regression: the smallest area was in image pixels, so fine silhouettes had no small blobs."""
    image = 255 * (np.random.default_rng(seed).random((20, 30)) < 0.1).astype(np.uint8)
    one, other = find_blobs(image, 1), find_blobs(image, times)
    assert (times * one.size_px == other.size_px).all()
    assert (times * (one.centre_px + 0.5) == other.centre_px + 0.5).all()
