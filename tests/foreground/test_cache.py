"""`psotrack cache`: entries are listed and removed; what is no entry stays."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import Output, cameras_of

from psotrack.foreground.silhouettes import Silhouettes, SilhouetteSettings, compute
from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.recordings import Recording, VideoWriter, probe
from psotrack.support import atomic_write

Run = Callable[..., Output]
SIZE_WH = (64, 48)
DAY_S = 24 * 3600
NAME_OF_PROGRAM = f"jit__scores-{'a' * 64}-cache"


def _compute(tmp_path: Path) -> Silhouettes:
    """Silhouettes of two videos, in the folder `cache`."""
    R, t_m = look_at((0.0, -5.0, 1.0), (0.0, 0.0, 1.0))
    K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    rig = make_rig({name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH) for name in ("a", "b")})
    for shift, name in enumerate(rig.names):
        with VideoWriter(tmp_path / f"{name}.avi", 25.0, SIZE_WH) as writer:
            for index in range(12):
                image = np.full((*SIZE_WH[::-1], 3), 150, np.uint8)
                cv2.circle(image, (10 + 3 * index, 20 + 5 * shift), 5, (20, 20, 20), -1)
                writer.write(image)
    videos = {name: probe(tmp_path / f"{name}.avi") for name in rig.names}
    settings = SilhouetteSettings(background="mog2", reduction=2, working_reduction=1, min_blob_px=9)
    return compute(
        Recording("flight", tmp_path, cameras_of(rig, video=videos)),
        settings,
        cache=tmp_path / "cache",
        jobs=1,
    )


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A cache with silhouettes of the videos a and b, a program, and what is not an entry."""
    keys = _compute(tmp_path).keys
    folder = tmp_path / "cache"
    (folder / "compiled").mkdir()
    (folder / "compiled" / NAME_OF_PROGRAM).write_bytes(b"a program")
    (folder / "compiled" / "notes-cache").write_text("mine")
    (folder / ("c" * 40)).mkdir()
    (folder / ("c" * 40) / "thesis.txt").write_text("mine")
    (tmp_path / "elsewhere").mkdir()
    (folder / ("d" * 40)).symlink_to(tmp_path / "elsewhere")
    # The program was used last, and the silhouettes of a were not used for 40 days.
    now_s = time.time()
    for path, age_s in ((folder / keys["a"] / "seal", 40 * DAY_S), (folder / keys["b"] / "seal", 9 * DAY_S)):
        os.utime(path, (now_s - age_s, now_s - age_s))
    return folder


def _listed(run: Run, cache: Path) -> list[dict[str, object]]:
    entries: list[dict[str, object]] = json.loads(run("cache", "--cache", cache, "--json", "-").out)[
        "entries"
    ]
    return entries


def _strangers(cache: Path) -> list[Path]:
    paths = cache / "compiled" / "notes-cache", cache / ("c" * 40) / "thesis.txt", cache / ("d" * 40)
    return [path for path in paths if path.exists()]


def test_entries_are_listed_the_oldest_first(run_psotrack: Run, cache: Path) -> None:
    entries = _listed(run_psotrack, cache)
    assert [(entry["kind"], entry["video"]) for entry in entries] == [
        ("silhouettes", "a.avi"),
        ("silhouettes", "b.avi"),
        ("program", ""),
    ]
    ages = [round(float(str(entry["days_unused"]))) for entry in entries]
    assert ages == [40, 9, 0]
    shown = run_psotrack("cache", "--cache", cache)
    assert shown.code == 0
    assert "a.avi" in shown.out
    assert "silhouettes of 2 videos, 1 programs" in shown.out


def test_prune_removes_what_is_old_and_then_what_is_too_much(run_psotrack: Run, cache: Path) -> None:
    shown = run_psotrack("cache", "--cache", cache, "--older-than", 30)
    assert "removed: silhouettes of 1 videos" in shown.out
    assert [entry["video"] for entry in _listed(run_psotrack, cache)] == ["b.avi", ""]
    run_psotrack("cache", "--cache", cache, "--max-gb", 1e-6)
    assert [entry["kind"] for entry in _listed(run_psotrack, cache)] == ["program"]


def test_what_a_killed_run_left_is_an_entry_and_what_a_running_one_writes_is_not(
    run_psotrack: Run, cache: Path
) -> None:
    """Found: parts of silhouettes stayed for ever unless the same key was made again."""
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True)
    with atomic_write(cache / ("e" * 40)) as running:
        running.mkdir()
    parts = [
        running.with_name(running.name.replace(f"-{os.getpid()}-", f"-{process}-"))
        for process in (int(ended.stdout), os.getpid())
    ]
    for part in parts:
        (part / "c" / "0").mkdir(parents=True)
        (part / "zarr.json").write_text("{}")
    assert str(parts[0]) in {str(entry["path"]) for entry in _listed(run_psotrack, cache)}
    run_psotrack("cache", "--empty", "--cache", cache)
    assert [path.exists() for path in parts] == [False, True]


def test_empty_leaves_what_is_no_entry_and_disturbs_no_reader(
    run_psotrack: Run, cache: Path, tmp_path: Path
) -> None:
    silhouettes = _compute(tmp_path)  # reads the stored ones, as a run does
    strangers = _strangers(cache)
    assert len(strangers) == 3
    run_psotrack("cache", "--empty", "--cache", cache)
    assert _listed(run_psotrack, cache) == []
    assert _strangers(cache) == strangers
    assert silhouettes.read(0, 12).any(), "the process goes on reading"


def test_a_folder_that_does_not_exist_is_named(run_psotrack: Run, tmp_path: Path) -> None:
    result = run_psotrack("cache", "--cache", tmp_path / "none")
    assert result.code == 2
    assert f"{tmp_path / 'none'}: expected a cache folder, found no such file or directory" in result.err
