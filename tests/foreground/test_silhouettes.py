"""Silhouettes: their settings, the store and the cache, frames that are left out, and blobs."""

import contextlib
import functools
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from helpers import assert_refused, cameras_of, far_camera, made_once, with_cameras
from hypothesis import given
from hypothesis import strategies as st
from worker_tasks import double, fail_and_be_ended

from psotrack.errors import PsotrackError
from psotrack.foreground.silhouettes import (
    SEAL_FILE,
    ForegroundSettings,
    Living,
    Mog2,
    SilhouetteSettings,
    blob_detections,
    border_cells,
    compute,
    coverage,
    find_blobs,
    foreground_is_everywhere,
    is_whole,
    learning_step,
    look_first,
    stored_silhouettes,
)
from psotrack.foreground.silhouettes.usable_frames import LEAST_FRAMES, in_words, intervals_of
from psotrack.geometry import make_rig
from psotrack.recordings import (
    Recording,
    TruncatedVideoError,
    VideoWriter,
    probe,
    probe_silhouettes,
    read_frames,
)
from psotrack.support import atomic_write, map_in_processes

NUM_FRAMES = 30
SIZE_WH = (162, 118)  # not multiples of 4
SETTINGS = SilhouetteSettings(
    background="mog2", reduction=4, working_reduction=2, min_blob_px=64, num_learning_frames=10
)
#: Frames of a longer video, and those in which its camera shows another picture in each frame.
NUM_USABLE, SHAKEN = 80, range(40, 55)


def _write_video(path, seed, num_frames=NUM_FRAMES, *, shaken=(), frozen=(), black=(), turns_at=None):
    """A video of a dark disc that moves in front of a smooth texture, with noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(90, 190, (5, 7, 3)).astype(np.float32)
    background = cv2.resize(coarse, SIZE_WH, interpolation=cv2.INTER_CUBIC)
    with VideoWriter(path, 25.0, SIZE_WH) as writer:
        for index in range(num_frames):
            image = background + rng.normal(0, 2, background.shape)
            if index in black:
                image[:] = 0
            elif index in shaken:
                image = cv2.resize(rng.uniform(0, 255, (12, 16, 3)), SIZE_WH)
            x = 20 + 120 * index // num_frames
            if turns_at:
                x = 140 - round(4 * abs(index - turns_at))
            cv2.circle(image, (x, 30 + 10 * seed), 9, (25, 25, 25), -1, cv2.LINE_AA)
            if index not in frozen:
                picture = np.clip(image, 0, 255).astype(np.uint8)
            writer.write(picture)


def _make_recording(folder):
    """A recording of all videos in a folder."""
    videos = {path.stem: probe(path) for path in sorted(folder.glob("*.avi"))}
    camera = far_camera(image_size_wh=SIZE_WH, pixels_per_m=20)
    rig = make_rig(dict.fromkeys(videos, camera))
    return Recording(folder.name, folder, cameras_of(rig, video=videos))


def _make_videos(folder):
    for seed in range(3):
        _write_video(folder / f"cam{seed + 1}.avi", seed)


video_folder = made_once("three_videos", _make_videos)


@pytest.fixture
def folder(video_folder, tmp_path):
    """Folder with three videos that a test may change."""
    return Path(shutil.copytree(video_folder, tmp_path / "videos"))


@pytest.fixture
def recording(folder):
    return _make_recording(folder)


@pytest.fixture
def decoded():
    """Gets the numbers of frames that `make` decodes, in this process and in others."""
    return []


@pytest.fixture
def make(tmp_path, decoded):
    """Computes the silhouettes of a recording in this process, into the cache of the test."""

    @contextlib.contextmanager
    def report(description, total):
        before = sum(decoded)
        yield decoded.append
        assert (description, total) == ("silhouettes", sum(decoded) - before)

    return functools.partial(compute, settings=SETTINGS, cache=tmp_path / "cache", jobs=1, report=report)


def _expected(recording):
    """Silhouettes without store, workers or chunks, (frames, cameras, height, width)."""
    scaled = SETTINGS.scaled([SIZE_WH])
    step = learning_step(recording.num_frames, scaled)
    factor = scaled.reduction // scaled.working_reduction
    cameras = []
    for video in recording.videos.values():
        masks = Mog2(scaled).foreground(read_frames(video, step), read_frames(video))
        cameras.append([coverage(mask, factor) for mask in masks])
    return np.stack(cameras, axis=1)


def _read_all(silhouettes):
    return silhouettes.read(0, silhouettes.num_frames)


def _keys(recording, settings=SETTINGS):
    return {name: each.key for name, each in stored_silhouettes(recording, settings, Path()).items()}


def _damage(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def _warnings(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


# --- settings


@pytest.mark.parametrize(
    ("settings", "size_wh", "usual_px", "expected"),
    [
        ({}, (1920, 1080), None, (2, 4, 9)),
        ({}, (3840, 2160), None, (4, 8, 9)),
        ({"background": "mog2"}, (1920, 1080), None, (2, 4, 64)),
        ({"drone_px": 12.0}, (3840, 2160), None, (1, 2, 6)),
        ({"reduction": 3}, (1920, 1080), None, (1, 3, 9)),
        ({"working_reduction": 3}, (1920, 1080), None, (3, 6, 9)),
        # A drone of 24 px is six stored values of 4 px wide: the background model needs no finer image.
        ({}, (1920, 1080), 24.0, (4, 4, 9)),
        ({}, (1920, 1080), 23.0, (2, 4, 9)),
    ],
)
def test_reductions_and_smallest_blob_follow_from_the_drones_size(settings, size_wh, usual_px, expected):
    scaled = SilhouetteSettings(**settings).scaled([size_wh], usual_px)
    assert (scaled.working_reduction, scaled.reduction, scaled.min_blob_px) == expected


def test_every_setting_the_model_and_the_number_of_frames_are_in_the_key(video_folder):
    changes = [
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
    names = set().union(*changes)
    assert names >= set(ForegroundSettings.__struct_fields__)
    recording = _make_recording(video_folder)
    keys = {_keys(recording)["cam1"], _keys(recording.usable(num_frames=12))["cam1"]}
    for change in changes:
        changed = msgspec.structs.replace(SETTINGS, **change)
        keys.add(_keys(recording, changed)["cam1"])
    assert len(keys) == 2 + len(changes)


# --- the store


def test_stored_silhouettes_equal_direct_computation(recording, make, decoded):
    for _ in range(2):
        silhouettes = make(recording)
    assert sum(decoded) == 3 * NUM_FRAMES, "the second call decodes nothing"
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
        with pytest.raises(PsotrackError, match=f"expected a part of 0 to 30, found {start} to {stop}"):
            silhouettes.read(start, stop)


def test_silhouettes_of_the_living_background_equal_those_of_frames_that_are_kept(recording, make, decoded):
    """The store decodes each frame once, over the one before; here all frames are kept."""
    settings = SilhouetteSettings(background="living", reduction=4, working_reduction=2, min_blob_px=64)
    silhouettes = make(recording, settings=settings)
    assert sum(decoded) == 3 * NUM_FRAMES
    scaled = settings.scaled([SIZE_WH])
    for camera, video in enumerate(recording.videos.values()):
        frames = list(read_frames(video))
        learning, reduced = look_first(video, iter(frames), scaled)
        masks = [coverage(mask, 2) for mask in Living(scaled).masks(learning, reduced)]
        assert np.any(masks)
        np.testing.assert_array_equal(_read_all(silhouettes)[:, camera], masks)


def test_only_what_is_missing_is_decoded(folder, tmp_path, make, decoded):
    shutil.copy(folder / "cam1.avi", folder / "cam2.avi")
    first = make(_make_recording(folder))
    assert sum(decoded) == 2 * NUM_FRAMES, "equal videos are decoded once"
    assert min(first.seconds["decode"], first.seconds["foreground"]) > 0
    before = _read_all(first)
    np.testing.assert_array_equal(before[:, 0], before[:, 1])
    decoded.clear()
    # Name and folder of a video are not in the key.
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    (moved / "cam3.avi").rename(moved / "other.avi")
    second = make(_make_recording(moved))
    assert decoded == []
    assert second.seconds["decode"] == second.seconds["foreground"] == 0
    np.testing.assert_array_equal(_read_all(second), before)
    # Fewer frames are made anew. What happens to the folder has no effect after reading.
    shorter = _make_recording(folder).usable(["cam3"], num_frames=12)
    np.testing.assert_array_equal(_read_all(make(shorter)), _expected(shorter))
    # The background is learned from every other frame.
    assert sum(decoded) == 12
    shutil.rmtree(tmp_path / "cache")
    np.testing.assert_array_equal(_read_all(first), before)


def test_no_changed_bit_and_no_truncation_goes_unnoticed(recording, tmp_path, make):
    stored = tmp_path / "cache" / make(recording).keys["cam1"]
    files = [path for path in stored.rglob("*") if path.is_file()]
    for file in files:
        content = file.read_bytes()
        for place in (0, len(content) // 2, len(content) - 1):
            changed = bytearray(content)
            changed[place] ^= 1
            for damaged in (changed, content[:place]):
                file.write_bytes(damaged)
                assert not is_whole(stored)
        file.write_bytes(content)
    assert is_whole(stored)


@pytest.mark.parametrize(
    ("file", "how", "brought"),
    [("c/0/0/0", _damage, True), ("c/0/0/0", Path.unlink, False), ("zarr.json", _damage, False)],
)
def test_damage_is_named_and_the_silhouettes_are_made_anew(
    recording, tmp_path, make, file, how, brought, caplog
):
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


def test_a_truncated_video_is_named_and_the_other_videos_are_kept(recording, tmp_path, make, decoded):
    video = recording.videos["cam3"].path
    os.truncate(video, video.stat().st_size * 2 // 3)
    found = []
    for jobs in (2, 1):
        with pytest.raises(TruncatedVideoError) as error_info:
            make(recording, jobs=jobs)
        error = error_info.value
        assert str(error).startswith(f"{video}: expected {NUM_FRAMES} frames, found ")
        found.append(error.num_readable)
    assert list((tmp_path / "cache").glob(".*")) == []
    decoded.clear()
    others = recording.usable(["cam1", "cam2"])
    np.testing.assert_array_equal(_read_all(make(others)), _expected(others))
    assert decoded == []
    assert found[0] == found[1]
    make(recording.usable(num_frames=found[0]))


def test_a_camera_without_video_sees_nothing_where_not_all_need_one(recording, make):
    made = make(with_cameras(recording, video={"cam2": None}), all_videos=False)
    assert made.cameras == ("cam1", "cam2", "cam3")
    assert set(made.keys) == {"cam1", "cam3"}
    shown = made.at_instants(recording.timeline())
    assert shown.exposures is not None
    there = np.tile([True, False, True], (NUM_FRAMES, 1))
    np.testing.assert_array_equal(shown.exposures.is_there, there)
    expected = _read_all(make(recording))
    expected[:, 1] = 0
    np.testing.assert_array_equal(_read_all(shown), expected)


def test_cameras_of_different_size_and_length_are_filled_up_with_background(folder, make):
    with VideoWriter(folder / "cam2.avi", 25.0, (202, 98)) as writer:
        frames = list(read_frames(probe(folder / "cam1.avi")))
        for frame in frames[:20]:
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


def test_what_is_ignored_is_background_and_belongs_to_the_key(recording, tmp_path, make):
    white = np.zeros(SIZE_WH[::-1], np.uint8)
    white[:, :81] = 255
    cv2.imwrite(str(tmp_path / "left.png"), white)
    plain = make(recording)
    without = make(with_cameras(recording, ignore={"cam1": tmp_path / "left.png"}))
    changed = {name for name, key in plain.keys.items() if key != without.keys[name]}
    assert changed == {"cam1"}
    before, after = _read_all(plain), _read_all(without)
    # Working pixels are 2 x 2: pixel 40 covers columns 80 and 81, of which one is ignored.
    assert before[:, 0, :, :20].any()
    assert not after[:, 0, :, :20].any()
    np.testing.assert_array_equal(after[:, 0, :, 21:], before[:, 0, :, 21:])
    np.testing.assert_array_equal(after[:, 1:], before[:, 1:])


def _with_small_mask(recording):
    path = recording.folder / "small.png"
    cv2.imwrite(str(path), np.zeros((10, 10), np.uint8))
    return with_cameras(recording, ignore={"cam1": path})


def _without_video(recording):
    return with_cameras(recording, video={"cam2": None})


def _without_file(recording):
    recording.videos["cam2"].path.unlink()
    return recording


#: Name of the case -> what makes the recording bad, and words of the line.
BAD = {
    "small mask": (_with_small_mask, "small.png: expected 162 x 118 "),
    "no video": (_without_video, "expected a video for each of the cameras "),
    "no file": (_without_file, "cam2.avi: expected a readable video, found no such file"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_missing_or_wrong_is_named(case, recording, make):
    change, words = BAD[case]
    bad = functools.partial(make, change(recording))
    assert_refused(bad, words, unchanged=recording.folder)


def test_settings_of_another_background_are_refused():
    with pytest.raises(PsotrackError, match="shadows: expected keep, because the background model living"):
        SilhouetteSettings(shadows="drop")


# --- other processes


def test_results_come_in_the_order_of_tasks_and_a_process_that_dies_is_said():
    done = []
    assert map_in_processes(double, [5, 3, 4, 1], jobs=2, advance=done.append) == [10, 6, 8, 2]
    assert sorted(done) == [1, 3, 4, 5]
    died = "a worker process: expected a result, found that the process died"
    with pytest.raises(PsotrackError, match=died):
        map_in_processes(double, [1, -1, 3], jobs=2, advance=done.append)


def test_a_worker_that_is_ended_while_it_cleans_up_leaves_nothing(tmp_path):
    """Found: the folder of half an array, where the signal came while the folder was being removed."""
    with pytest.raises(PsotrackError, match="the process died"):
        map_in_processes(fail_and_be_ended, [tmp_path / "a", tmp_path / "b"], jobs=2, advance=int)
    assert list(tmp_path.iterdir()) == []


def test_workers_do_not_import_jax():
    program = (
        "import sys, psotrack.foreground.silhouettes.store, psotrack.support.processes;"
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


# --- the command `cache`


def test_entries_are_listed_and_pruned_the_oldest_first_and_what_is_no_entry_stays(
    run_psotrack, recording, tmp_path, make
):
    cache = tmp_path / "cache"
    command = functools.partial(run_psotrack, "cache", "--cache", cache)

    def listed():
        entries = json.loads(command("--json", "-").out)["entries"]
        return [(entry["kind"], entry["video"]) for entry in entries]

    made = make(recording.usable(["cam1", "cam2"]))
    now_s = time.time()
    days_ago_s = now_s - 40 * 24 * 3600
    for seal in cache.glob(f"*/{SEAL_FILE}"):
        os.utime(seal, (days_ago_s, days_ago_s))
    make(recording.usable(["cam2"]))
    program = cache / "compiled" / f"jit__scores-{'a' * 64}-cache"
    notes = cache / "compiled" / "notes-cache"
    thesis = cache / ("c" * 40) / "thesis.txt"
    for path in (notes, thesis, program):
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine, or a program")
    os.utime(program, (now_s + 60, now_s + 60))  # used last
    link = cache / ("d" * 40)
    link.symlink_to(recording.folder)
    assert listed() == [("silhouettes", "cam1.avi"), ("silhouettes", "cam2.avi"), ("program", "")]
    assert "silhouettes of 2 videos, 1 programs" in command().out
    assert "removed: silhouettes of 1 videos" in command("--older-than", 30).out
    assert listed() == [("silhouettes", "cam2.avi"), ("program", "")]
    command("--max-gb", 1e-6)
    assert listed() == [("program", "")]
    # Found: what a killed run left stayed for ever unless the same key was made again.
    with atomic_write(cache / ("e" * 40)) as used:
        # No process has this number.
        left = used.with_name(used.name.replace(f"-{os.getpid()}-", f"-{2**30}-"))
        for part in (left, used):
            (part / "c" / "0").mkdir(parents=True)
            (part / "zarr.json").write_text("{}")
        assert f"{left}" in command("--json", "-").out
        command("--empty")
        assert listed() == []
        assert set(cache.iterdir()) == {notes.parent, thesis.parent, link, used}
    assert notes.exists()
    assert thesis.exists()
    assert made.read(0, 12).any(), "a process that has read the silhouettes goes on"


# --- frames that are left out


def test_foreground_is_everywhere_where_most_parts_of_the_image_have_some():
    speckle = np.zeros((5, 90, 160), np.uint8)
    speckle[1, 5::10, 5::10] = 255  # a cell in each part
    speckle[2, :60, :50] = 255  # a large object
    speckle[3, 15::20, 5::10] = 255  # less than half of the parts
    # Ten drones, each where four parts of the image meet.
    for x in range(10, 160, 30):
        speckle[4, 15:25, x - 5 : x + 5] = 255
        speckle[4, 55:65, x - 5 : x + 5] = 255
    assert foreground_is_everywhere(speckle).tolist() == [False, True, False, False, False]


@given(st.lists(st.booleans(), max_size=60))
def test_intervals_are_the_chosen_frames(chosen):
    again = np.zeros(len(chosen), bool)
    chosen_frames = np.array(chosen, bool)
    intervals = intervals_of(chosen_frames)
    for start, stop in intervals:
        assert start < stop
        assert not again[max(start - 1, 0) : stop].any()
        again[start:stop] = True
    assert again.tolist() == chosen
    # Found: single key frames of a codec were left out in all cameras at once, and tracks were lost there.
    long = [(start, stop) for start, stop in intervals if stop - start >= LEAST_FRAMES]
    assert intervals_of(chosen_frames, LEAST_FRAMES) == long
    # In words, short gaps are left out.
    assert in_words([(3, 4), (10, 20), (22, 31), (60, 70)], gap_frames=25) == "3 to 30, 60 to 69"
    assert in_words([(3, 4), (40, 41)], gap_frames=25) == "3, 40"


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("shaken", "foreground is everywhere"),
        ("frozen", "they repeat the picture before"),
        ("black", "they do not show the scene"),
    ],
)
def test_a_camera_is_left_out_for_as_long_and_a_line_says_which_and_when(tmp_path, make, caplog, how, why):
    _write_video(tmp_path / "calm.avi", 0, NUM_USABLE)
    _write_video(tmp_path / "shaken.avi", 1, NUM_USABLE, **{how: SHAKEN})
    recording = _make_recording(tmp_path)
    for _ in range(2):  # computed, and read from the store
        caplog.clear()
        made = make(recording)
        # Some frames of a camera that shakes do not show the scene either.
        line = _warnings(caplog)[0]
        assert line.startswith("camera shaken: ")
        assert f" of 80 frames are left out, because {why}" in line
        assert "frames 40 to 54" in line
        assert made.left_out == {"shaken": [(40, 55)]}
    frames = _read_all(made)
    assert not frames[40:55, 1].any()
    assert frames[:, 0].any(axis=(1, 2)).all()
    # The camera has no frame at these instants, and no blob.
    timeline = recording.timeline()
    there = np.ones((NUM_USABLE, 2), bool)
    there[SHAKEN, 1] = False
    every = made.at_instants(timeline)
    some = made.at_instants(timeline.part(np.arange(50, NUM_USABLE)))
    for shown, start in ((every, 0), (some, 50), (every.part(50, NUM_USABLE), 50)):
        assert shown.exposures is not None
        np.testing.assert_array_equal(shown.exposures.is_there, there[start:])
        np.testing.assert_array_equal(_read_all(shown), frames[start:])
    boxes = blob_detections(made, np.array([SIZE_WH, SIZE_WH], float))
    with_blobs = set(boxes["shaken"].frame.tolist())
    assert with_blobs == set(range(NUM_USABLE)) - set(SHAKEN)


def test_a_frame_in_which_what_moves_stands_still_for_a_moment_is_no_repetition(tmp_path, make):
    """Found: one of 60 frames of a calm video was left out. A disc turns back between the frames 20 and 21."""
    _write_video(tmp_path / "calm.avi", 1, 60, turns_at=20.5)
    _write_video(tmp_path / "frozen.avi", 1, 60, turns_at=20.5, frozen=(33, 41, 42))
    assert make(_make_recording(tmp_path)).left_out == {"frozen": [(33, 34), (41, 43)]}


# --- blobs


def test_blobs_by_hand():
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
    # Found: the smallest area was in image pixels, so fine silhouettes had no small blobs.
    fine = find_blobs(image, 1)
    assert fine.size_px.tolist() == [[6, 4], [3, 4], [2, 1]]
    # The same image in an array that a larger image of another camera needs.
    filled_up = np.pad(image, ((0, 10), (0, 10)))
    assert find_blobs(filled_up, 4).whole.tolist() == [True, True, True]
    border = border_cells(np.array([118.0, 80.0]), 4)
    assert find_blobs(filled_up, 4, border).whole.tolist() == [True, False, True]


def test_blobs_are_those_of_the_whole_silhouette():
    """Only the part about the foreground is looked at; faint cells in the corners make it the whole silhouette."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        image = np.zeros((24, 30), np.uint8)
        y, x = rng.integers(0, 20, 2)
        part = image[y : y + 8, x : x + 8]
        part[rng.random(part.shape) < 0.4] = 255
        whole = image.copy()
        whole[::23, ::29] = np.maximum(whole[::23, ::29], 1)
        found, expected = find_blobs(image, 4), find_blobs(whole, 4)
        for name, values in vars(found).items():
            np.testing.assert_array_equal(values, getattr(expected, name))


def test_all_blobs_of_a_silhouette_count_from_large_to_small():
    """An image has 70 blobs of increasing width. Regression: only the 50 largest counted, without a word."""
    image = np.zeros((70 * 5 + 4, 90), np.uint8)
    for number in range(70):
        top = 5 * number + 4
        image[top : top + 2, 4 : 6 + number] = 255
    width_px = find_blobs(image, 3).size_px[:, 0]
    np.testing.assert_array_equal(width_px, 3 * np.arange(71, 1, -1))
