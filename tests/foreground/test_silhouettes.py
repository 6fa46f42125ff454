"""The store of silhouettes: its content, the reasons to compute silhouettes again, and interruptions."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from helpers import cameras_of, with_cameras
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    Living,
    Mog2,
    Silhouettes,
    SilhouetteSettings,
    compute,
    coverage,
    is_whole,
    learning_step,
    list_entries,
    look_first,
    remove_entry,
    stored_silhouettes,
    usual_drone_px,
)
from psotrack.foreground.silhouettes import store as silhouette_store
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
from psotrack.support import Advance, map_in_processes

NUM_FRAMES = 30
SIZE_WH = (162, 118)  # not multiples of 4
SETTINGS = SilhouetteSettings(
    background="mog2", reduction=4, working_reduction=2, min_blob_px=64, num_learning_frames=10
)


def _write_video(path: Path, seed: int, num_frames: int = NUM_FRAMES) -> None:
    """Write a video of a dark disc that moves in front of a smooth texture, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(90, 190, (5, 7, 3)).astype(np.float32)
    background = cv2.resize(coarse, SIZE_WH, interpolation=cv2.INTER_CUBIC)
    with VideoWriter(path, 25.0, SIZE_WH) as writer:
        for index in range(num_frames):
            image = background + rng.normal(0, 2, background.shape)
            cv2.circle(image, (20 + 4 * index, 30 + 10 * seed), 9, (25, 25, 25), -1, cv2.LINE_AA)
            writer.write(np.clip(image, 0, 255).astype(np.uint8))


def _make_recording(folder: Path) -> Recording:
    """Make a recording of all videos in a folder."""
    R, t_m = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
    K = np.array([[100.0, 0, 81], [0, 100, 59], [0, 0, 1]])
    videos = {path.stem: probe(path) for path in sorted(folder.glob("*.avi"))}
    rig = make_rig({name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH) for name in videos})
    return Recording(folder.name, folder, cameras_of(rig, video=videos))


@pytest.fixture(scope="session")
def video_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for seed in range(3):
        _write_video(folder / f"cam{seed + 1}.avi", seed)
    return folder


@pytest.fixture
def folder(video_folder: Path, tmp_path: Path) -> Path:
    """Folder with three videos that a test may change."""
    return Path(shutil.copytree(video_folder, tmp_path / "videos"))


@pytest.fixture
def decoded_videos(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """List that gets the name of the video of each frame that this process decodes, in order."""
    names: list[str] = []

    def read_and_count(video, step=1, **how):  # type: ignore[no-untyped-def]
        for frame in read_frames(video, step, **how):
            names.append(video.path.stem)
            yield frame

    monkeypatch.setattr(silhouette_store, "read_frames", read_and_count)
    return names


def _expected(recording: Recording, settings: SilhouetteSettings = SETTINGS) -> np.ndarray:
    """Compute silhouettes without store, workers or chunks, (frames, cameras, height, width)."""
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


def _unfinished_folders(cache: Path) -> list[Path]:
    return list(cache.glob(".*"))


def _keys(recording: Recording, settings: SilhouetteSettings = SETTINGS) -> dict[str, str]:
    return {name: each.key for name, each in stored_silhouettes(recording, settings, Path()).items()}


@pytest.mark.parametrize("jobs", [1, 2])
def test_stored_silhouettes_equal_direct_computation(folder: Path, tmp_path: Path, jobs: int) -> None:
    started: list[tuple[str, int]] = []
    done: list[int] = []

    @contextlib.contextmanager
    def report(description: str, total: int) -> Iterator[Advance]:
        started.append((description, total))
        yield done.append

    recording = _make_recording(folder)
    for _ in range(2):
        silhouettes = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=jobs, report=report)
    assert started == [("silhouettes", 3 * (NUM_FRAMES + 10))], "the second call reports no progress"
    assert sum(done) == 3 * (NUM_FRAMES + 10)
    assert silhouettes.cameras == ("cam1", "cam2", "cam3")
    assert silhouettes.shape == (30, 41)
    assert (silhouettes.num_frames, silhouettes.reduction) == (NUM_FRAMES, 4)
    assert silhouettes.keys == _keys(recording)
    all_frames = _read_all(silhouettes)
    assert all_frames.dtype == np.uint8
    assert all_frames.flags.c_contiguous
    np.testing.assert_array_equal(all_frames, _expected(recording))
    assert all_frames.any(axis=(2, 3)).all(), "every frame of every camera shows a disc"
    assert _unfinished_folders(tmp_path / "cache") == []
    for start, stop in [(0, 0), (0, 1), (7, 26), (24, 26), (25, 30), (30, 30)]:
        np.testing.assert_array_equal(silhouettes.read(start, stop), all_frames[start:stop])
    for start, stop in [(-1, 5), (5, 31), (6, 5)]:
        with pytest.raises(SettingsError, match=f"expected a part of 0 to 30, found {start} to {stop}"):
            silhouettes.read(start, stop)


def test_silhouettes_of_the_living_background_equal_those_of_frames_that_are_kept(
    folder: Path, tmp_path: Path
) -> None:
    """The store decodes each frame over the one before; here all frames are kept."""
    recording = _make_recording(folder)
    settings = SilhouetteSettings(background="living", reduction=4, working_reduction=2, min_blob_px=64)
    silhouettes = compute(recording, settings, cache=tmp_path / "cache", jobs=1)
    scaled = settings.scaled([SIZE_WH])
    for camera, video in enumerate(recording.videos.values()):
        looked_at = look_first(video, iter(list(read_frames(video))), scaled)
        masks = [coverage(mask, 2) for mask in Living(scaled).masks(*looked_at)]
        assert np.any(masks)
        np.testing.assert_array_equal(_read_all(silhouettes)[:, camera], masks)


def test_only_what_is_missing_is_decoded(folder: Path, tmp_path: Path, decoded_videos: list[str]) -> None:
    shutil.copy(folder / "cam1.avi", folder / "cam2.avi")
    first = compute(_make_recording(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert len(decoded_videos) == 2 * (NUM_FRAMES + 10), "equal videos are decoded once"
    assert first.seconds["decode"] > 0
    assert first.seconds["foreground"] > 0
    before = _read_all(first)
    np.testing.assert_array_equal(before[:, 0], before[:, 1])
    decoded_videos.clear()
    # Name and folder of a video are not in the key.
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    (moved / "cam3.avi").rename(moved / "other.avi")
    second = compute(_make_recording(moved), SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert decoded_videos == []
    assert second.seconds == {"decode": 0.0, "foreground": 0.0}
    np.testing.assert_array_equal(_read_all(second), before)
    _write_video(folder / "cam2.avi", seed=5)
    recording = _make_recording(folder)
    third = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert set(decoded_videos) == {"cam2"}
    np.testing.assert_array_equal(_read_all(third), _expected(recording))
    np.testing.assert_array_equal(_read_all(first), before)


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
    with pytest.raises(SettingsError, match=r"background: expected .*found liveing"):
        _keys(recording, SilhouetteSettings(background="liveing"))


@pytest.mark.parametrize(
    ("settings", "sizes_wh", "expected"),
    [
        ({}, [(1920, 1080)], (2, 4, 9)),
        ({}, [(640, 512), (1920, 1080)], (2, 4, 9)),
        ({}, [(3840, 2160)], (4, 8, 9)),
        ({}, [(1080, 1920)], (2, 4, 9)),
        ({}, [(640, 512)], (1, 2, 9)),
        ({}, [(160, 120)], (1, 1, 9)),
        ({"background": "mog2"}, [(1920, 1080)], (2, 4, 64)),
        ({"background": "mog2"}, [(160, 120)], (1, 1, 4)),
        ({"drone_px": 40.0}, [(1920, 1080)], (2, 4, 64)),
        ({"drone_px": 12.0}, [(3840, 2160)], (1, 2, 6)),
        ({"drone_px": 5.0}, [(3840, 2160)], (1, 1, 4)),
        ({"drone_px": 100.0}, [(640, 512)], (5, 10, 400)),
        ({"reduction": 3}, [(1920, 1080)], (1, 3, 9)),
        ({"working_reduction": 3}, [(1920, 1080)], (3, 6, 9)),
        ({"min_blob_px": 0}, [(1920, 1080)], (2, 4, 0)),
    ],
)
def test_reduction_and_smallest_blob_follow_from_the_drones_size(
    settings: dict[str, Any], sizes_wh: list[tuple[int, int]], expected: tuple[int, int, int]
) -> None:
    scaled = SilhouetteSettings(**settings).scaled(sizes_wh)
    assert (scaled.working_reduction, scaled.reduction, scaled.min_blob_px) == expected


@pytest.mark.parametrize(
    ("settings", "usual_px", "expected"),
    [
        # A drone of 24 px is six stored values of 4 px wide: the background model needs no finer image.
        ({}, 24.0, (4, 4)),
        ({}, 23.0, (2, 4)),
        ({}, 500.0, (4, 4)),
        ({"reduction": 8}, 500.0, (8, 8)),
        ({"drone_px": 40.0}, 500.0, (2, 4)),
        ({"working_reduction": 1}, 500.0, (1, 2)),
    ],
)
def test_the_background_model_sees_no_finer_image_than_the_rig_demands(
    settings: dict[str, Any], usual_px: float, expected: tuple[int, int]
) -> None:
    scaled = SilhouetteSettings(**settings).scaled([(1920, 1080)], usual_px)
    assert (scaled.working_reduction, scaled.reduction) == expected


def test_the_usual_width_of_a_drone_follows_from_the_rig() -> None:
    K = np.array([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
    poses = {
        name: look_at(eye, (0.0, 0.0, 1.0)) for name, eye in (("a", (6.0, 0.0, 1.0)), ("b", (0.0, 3.0, 1.0)))
    }
    cameras = {
        name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080)) for name, (R, t_m) in poses.items()
    }
    # 0.3 m at 6 m, in the farther camera.
    assert usual_drone_px(make_rig(cameras)) == pytest.approx(50.0)
    assert usual_drone_px(make_rig({"a": cameras["a"]})) is None


@pytest.mark.parametrize(
    ("setting", "value"), [("shadows", "drop"), ("var_threshold", 9.0), ("learning_rate", 0.1)]
)
def test_what_the_living_background_does_not_use_is_refused(setting: str, value: object) -> None:
    with pytest.raises(
        SettingsError, match=rf"{setting}: expected .*the background model living does not use"
    ):
        SilhouetteSettings(**{setting: value})
    assert getattr(SilhouetteSettings(background="mog2", **{setting: value}), setting) == value


def test_fewer_frames_are_made_anew(folder: Path, tmp_path: Path) -> None:
    shorter = _make_recording(folder).usable(num_frames=12)
    silhouettes = compute(shorter, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert silhouettes.num_frames == 12
    np.testing.assert_array_equal(_read_all(silhouettes), _expected(shorter))


@pytest.fixture(scope="module")
def whole_cache(video_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cache = tmp_path_factory.mktemp("whole")
    compute(_make_recording(video_folder), SETTINGS, cache=cache, jobs=1)
    return cache


@settings(max_examples=30)
@given(data=st.data())
def test_no_changed_bit_and_no_truncation_goes_unnoticed(whole_cache: Path, data: st.DataObject) -> None:
    """Whole folders pass, and a folder with one changed bit or a file cut short does not."""
    folder = min(path for path in whole_cache.iterdir() if not path.name.startswith("."))
    assert is_whole(folder)
    file = data.draw(st.sampled_from(sorted(path for path in folder.rglob("*") if path.is_file())))
    content = file.read_bytes()
    damaged = bytearray(content)
    if data.draw(st.booleans()):
        damaged[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    else:
        del damaged[data.draw(st.integers(0, len(content) - 1)) :]
    try:
        file.write_bytes(damaged)
        assert not is_whole(folder)
    finally:
        file.write_bytes(content)


@pytest.mark.parametrize("file", ["c/0/0/0", "zarr.json", "seal"])
@pytest.mark.parametrize("is_missing", [False, True])
def test_damage_is_named_and_the_silhouettes_are_made_anew(
    folder: Path, tmp_path: Path, file: str, is_missing: bool, caplog: pytest.LogCaptureFixture
) -> None:
    recording = _make_recording(folder)
    first = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    damaged = tmp_path / "cache" / first.keys["cam2"]
    content = bytearray((damaged / file).read_bytes())
    content[len(content) // 2] ^= 1
    (damaged / file).write_bytes(content)
    if is_missing:
        (damaged / file).unlink()
    caplog.clear()
    again = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert lines == [f"{damaged}: damaged silhouettes; they are made anew"]
    assert is_whole(damaged)
    np.testing.assert_array_equal(_read_all(again), _expected(recording))


@pytest.mark.parametrize("is_missing", [False, True])
def test_damaged_silhouettes_beside_a_video_are_named_and_made_from_it(
    folder: Path, tmp_path: Path, is_missing: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """The recording itself brings these silhouettes, as an archive does."""
    recording = _make_recording(folder)
    first = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    brought = tmp_path / "brought"
    (tmp_path / "cache" / first.keys["cam2"]).rename(brought)
    recording = with_cameras(recording, silhouettes={"cam2": probe_silhouettes(brought)})
    compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert not (tmp_path / "cache" / first.keys["cam2"]).exists()
    if is_missing:
        (brought / "c/0/0/0").unlink()
    else:
        content = bytearray((brought / "c/0/0/0").read_bytes())
        content[len(content) // 2] ^= 0xFF
        (brought / "c/0/0/0").write_bytes(content)
    caplog.clear()
    again = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert lines == [f"{brought}: damaged silhouettes; they are made anew"]
    np.testing.assert_array_equal(_read_all(again), _expected(recording))


def test_what_happens_to_the_folder_has_no_effect_after_reading(folder: Path, tmp_path: Path) -> None:
    silhouettes = compute(_make_recording(folder), SETTINGS, cache=tmp_path / "cache", jobs=1)
    before = _read_all(silhouettes)
    (tmp_path / "cache" / silhouettes.keys["cam2"] / "c" / "0" / "0" / "0").write_bytes(b"damaged")
    for entry in list_entries(tmp_path / "cache"):
        remove_entry(entry)
    assert list_entries(tmp_path / "cache") == []
    np.testing.assert_array_equal(_read_all(silhouettes), before)


# --- errors ---


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_truncated_video_is_named_and_the_other_videos_are_kept(
    folder: Path, tmp_path: Path, jobs: int
) -> None:
    recording = _make_recording(folder)
    video = folder / "cam3.avi"
    content = video.read_bytes()
    video.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(InputError) as error_info:
        compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=jobs)
    assert str(error_info.value).startswith(f"{video}: expected {NUM_FRAMES} frames, found ")
    assert _unfinished_folders(tmp_path / "cache") == []
    video.write_bytes(content)
    np.testing.assert_array_equal(
        _read_all(compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)), _expected(recording)
    )


def test_a_truncated_video_of_half_the_rate_is_advised_in_instants(folder: Path, tmp_path: Path) -> None:
    """`--frames` counts instants at the rate of the fastest camera, not frames of the truncated video."""
    recording = _make_recording(folder)
    recording = with_cameras(recording, times={"cam3": FrameTimes(NUM_FRAMES, fps=12.5)})
    video = folder / "cam3.avi"
    content = video.read_bytes()
    video.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(TruncatedVideoError) as error_info:
        compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=2)
    # The commands with `--frames` advise this number.
    readable, advised = error_info.value.num_readable, error_info.value.num_instants
    # Frame i of the slow camera is nearest to instants 2i - 1 (or 2i - 1 and 2i) to 2i + 1.
    assert 2 * readable - 1 <= advised <= 2 * readable
    compute(recording.usable(num_frames=advised), SETTINGS, cache=tmp_path / "cache", jobs=1)
    with pytest.raises(InputError, match="can be decoded"):
        compute(recording.usable(num_frames=advised + 1), SETTINGS, cache=tmp_path / "cache", jobs=1)


def test_a_camera_without_video_sees_nothing_where_not_all_need_one(folder: Path, tmp_path: Path) -> None:
    recording = _make_recording(folder)
    two = with_cameras(recording, video={"cam2": None})
    made = compute(two, SETTINGS, cache=tmp_path / "cache", all_videos=False)
    assert made.cameras == ("cam1", "cam2", "cam3")
    assert set(made.keys) == {"cam1", "cam3"}
    shown = made.at_instants(recording.timeline())
    assert shown.exposures is not None
    assert shown.exposures.is_there.all(axis=0).tolist() == [True, False, True]
    assert shown.exposures.is_there.any(axis=0).tolist() == [True, False, True]
    both = compute(recording, SETTINGS, cache=tmp_path / "cache")
    np.testing.assert_array_equal(_read_all(shown)[:, [0, 2]], _read_all(both)[:, [0, 2]])
    assert not _read_all(shown)[:, 1].any()
    with pytest.raises(InputError, match="expected at least one video, found none"):
        compute(
            with_cameras(recording, video=dict.fromkeys(recording.videos)),
            SETTINGS,
            cache=tmp_path / "cache",
            all_videos=False,
        )


def test_cameras_of_different_size_and_length_are_filled_up_with_background(
    folder: Path, tmp_path: Path
) -> None:
    with VideoWriter(folder / "cam2.avi", 25.0, (202, 98)) as writer:
        for frame in itertools.islice(read_frames(probe(folder / "cam1.avi")), 20):
            writer.write(cv2.copyMakeBorder(frame[20:], 0, 0, 0, 40, cv2.BORDER_REPLICATE))
    recording = _make_recording(folder)
    recording.by_name["cam2"].camera.image_size_wh[:] = (202, 98)
    silhouettes = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
    assert silhouettes.shape == (30, 51)
    frames = _read_all(silhouettes)
    assert frames.shape == (NUM_FRAMES, 3, 30, 51)
    for index, name in enumerate(recording.rig.names):
        alone = _expected(recording.usable([name]))[:, 0]
        num_frames, height, width = alone.shape
        np.testing.assert_array_equal(frames[:num_frames, index, :height, :width], alone)
        assert alone.any()
        assert not frames[num_frames:, index].any()
        assert not frames[:, index, height:].any()
        assert not frames[:, index, :, width:].any()


def test_what_is_ignored_is_background_and_belongs_to_the_key(folder: Path, tmp_path: Path) -> None:
    recording = _make_recording(folder)
    white = np.zeros(SIZE_WH[::-1], np.uint8)
    white[:, :81] = 255
    cv2.imwrite(str(tmp_path / "left.png"), white)
    masked = with_cameras(recording, ignore={"cam1": tmp_path / "left.png"})
    plain, without = (
        compute(each, SETTINGS, cache=tmp_path / "cache", jobs=1) for each in (recording, masked)
    )
    assert {name for name in plain.keys if plain.keys[name] != without.keys[name]} == {"cam1"}
    before, after = _read_all(plain), _read_all(without)
    # Working pixels are 2 x 2: pixel 40 covers columns 80 and 81, of which one is ignored.
    assert before[:, 0, :, :20].any()
    assert not after[:, 0, :, :20].any()
    np.testing.assert_array_equal(after[:, 0, :, 21:], before[:, 0, :, 21:])
    np.testing.assert_array_equal(after[:, 1:], before[:, 1:])


@pytest.mark.parametrize("reduction", [0, -4, 3, True])
def test_invalid_reductions_are_refused(reduction: int) -> None:
    with pytest.raises(SettingsError, match="reduction: expected a "):
        SilhouetteSettings(reduction=reduction, working_reduction=2)


def test_what_is_missing_or_wrong_is_named(folder: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    recording = _make_recording(folder)
    with pytest.raises(SettingsError, match="jobs: expected a whole number of at least 1, found 0"):
        compute(recording, SETTINGS, cache=cache, jobs=0)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match=r"small\.png: expected 162 x 118 .* as in cam1\.avi, found 10 x 10"):
        compute(
            with_cameras(recording, ignore={"cam1": tmp_path / "small.png"}), SETTINGS, cache=cache, jobs=1
        )
    two = with_cameras(recording, video={"cam2": None})
    with pytest.raises(InputError, match=r"expected a video for each of the cameras .* found none for cam2"):
        compute(two, SETTINGS, cache=cache)
    (folder / "cam2.avi").unlink()
    with pytest.raises(InputError, match=r"cam2\.avi: expected a readable video, found No such file"):
        compute(recording, SETTINGS, cache=cache)
    shutil.rmtree(cache, ignore_errors=True)
    cache.write_text("mine")
    with pytest.raises(OutputError, match=r"cache/.*: expected a path that can be written, found "):
        compute(two, SETTINGS, cache=cache, jobs=1, all_videos=False)
    assert cache.read_text() == "mine"


# --- other processes ---


def _run_program(
    folder: Path,
    cache: Path,
    *,
    before: str = "",
    settings: str = "SETTINGS",
    action: str = "pass",
    after_frames: int = 0,
) -> subprocess.CompletedProcess[str]:
    """Run a program that computes the silhouettes of a folder in two worker processes.

    The program runs the statement `action` itself after `after_frames` reported frames, because a test that watched the
    program from outside might react too late. The program and its workers have ended when this function returns.
    """
    program = f"""
        import contextlib, os, signal, sys
        # A test run in the background ignores SIGINT, and its children inherit this.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from pathlib import Path
        from test_silhouettes import SETTINGS, SilhouetteSettings, _make_recording, compute
        {before}

        @contextlib.contextmanager
        def report(description, total):
            done = 0

            def advance(steps):
                nonlocal done
                done += steps
                if done >= {after_frames}:
                    {action}

            advance(0)
            yield advance

        compute(
            _make_recording(Path({str(folder)!r})), {settings}, cache=Path({str(cache)!r}), jobs=2, report=report
        )
    """
    running = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    _, stderr = running.communicate()
    # Workers close stderr shortly before the system removes them: until then, what they write is not left over.
    until_s = time.monotonic() + 30
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < until_s:
            os.killpg(running.pid, 0)
            time.sleep(0.01)
    return subprocess.CompletedProcess(running.args, running.returncode, None, stderr)


def _stored_keys(cache: Path) -> list[str]:
    """Return the keys of the stored silhouettes."""
    return [path.name for path in cache.glob("[!.]*")]


# There are 120 frames in total: each camera has 10 frames to learn the background and 30 frames; a chunk has 25 frames.
@pytest.mark.parametrize("after_frames", [0, 1, 75, 100])
@pytest.mark.parametrize("whole_group", [False, True])
@pytest.mark.slow
def test_a_killed_computation_is_resumed(
    folder: Path, tmp_path: Path, decoded_videos: list[str], after_frames: int, whole_group: bool
) -> None:
    cache = tmp_path / "cache"
    target = "0" if whole_group else "os.getpid()"
    killed = _run_program(
        folder, cache, action=f"os.kill({target}, signal.SIGKILL)", after_frames=after_frames
    )
    assert killed.returncode == -signal.SIGKILL
    if not whole_group:
        # The workers notice the end of their parent and remove their unfinished folders.
        assert not _unfinished_folders(cache)
    recording = _make_recording(folder)
    keys = _keys(recording)
    finished = _stored_keys(cache)
    resumed = compute(recording, SETTINGS, cache=cache, jobs=1)
    assert set(decoded_videos) == {name for name, key in keys.items() if key not in finished}
    assert not _unfinished_folders(cache)
    np.testing.assert_array_equal(_read_all(resumed), _expected(recording))


def test_ctrl_c_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    interrupted = _run_program(
        folder,
        tmp_path / "cache",
        # A long grace period keeps slow workers from being killed; their duration is not part of this test.
        before="from psotrack.support import processes; processes.GRACE_S = 3600",
        action="os.kill(0, signal.SIGINT)",  # like a terminal, also to the workers
        after_frames=1,
    )
    assert interrupted.returncode == -signal.SIGINT
    assert interrupted.stderr.count("Traceback") == 1, "the workers print no traceback"
    assert _unfinished_folders(tmp_path / "cache") == []


@pytest.mark.slow
def test_two_computations_at_once_do_not_disturb_each_other(
    folder: Path, tmp_path: Path, decoded_videos: list[str]
) -> None:
    cache = tmp_path / "cache"
    with ThreadPoolExecutor(2) as threads:
        both = list(threads.map(lambda _: _run_program(folder, cache), range(2)))
    assert [(result.returncode, result.stderr) for result in both] == [(0, "")] * 2
    assert _unfinished_folders(cache) == []
    recording = _make_recording(folder)
    silhouettes = compute(recording, SETTINGS, cache=cache, jobs=1)
    assert decoded_videos == []
    np.testing.assert_array_equal(_read_all(silhouettes), _expected(recording))


def test_full_disk(folder: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    before = _read_all(compute(_make_recording(folder), SETTINGS, cache=cache, jobs=1))
    full = _run_program(
        folder,
        cache,
        # Files are limited to 4 kB, so writing noise fails as on a full disk. Bytecode is not written, because the
        # limit would truncate it too.
        before="import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))",
        settings="SilhouetteSettings(background='mog2', reduction=2, min_blob_px=0, var_threshold=0.1)",
    )
    assert full.returncode == 1
    assert "OutputError" in full.stderr
    assert "expected a path that can be written, found File too large; earlier results" in full.stderr
    assert _unfinished_folders(cache) == []
    assert len(_stored_keys(cache)) == 3
    np.testing.assert_array_equal(
        _read_all(compute(_make_recording(folder), SETTINGS, cache=cache, jobs=1)), before
    )


def test_workers_do_not_import_jax() -> None:
    program = (
        "import sys, psotrack.foreground.silhouettes.store, psotrack.support.processes;"
        "sys.exit('jax' in sys.modules)"
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


def test_errors_of_workers_keep_their_type_and_message() -> None:
    with pytest.raises(SettingsError, match=r"^task: expected a number of at least 0, found -2$"):
        map_in_processes(_double, [1, -2, 3], jobs=2, advance=lambda steps: None)


def test_a_worker_that_dies_is_an_error() -> None:
    with pytest.raises(
        PsotrackError, match="a worker process: expected a result, found that the process died"
    ):
        map_in_processes(_double, [1, -1, 3], jobs=2, advance=lambda steps: None)
