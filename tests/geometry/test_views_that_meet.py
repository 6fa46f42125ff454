"""Rigs in whose cameras' common view no drone can be found: one line says why, and what to do."""

import numpy as np
import pytest
from board_rigs import record_detections
from helpers import assert_refused, make_unnamed_rig

from psotrack.geometry import look_at, make_camera, project, views_meet
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections

FRAMES = 40


def camera(centre_m, target_m, focal_px=1000.0, dist=()):
    R, t_m = look_at(centre_m, target_m)
    K = np.array([[focal_px, 0, 960], [0, focal_px, 540], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, dist=dist, image_size_wh=(1920, 1080))


def rig_of(*looks, **lens):
    """Cameras at places that look at targets, pairs of both."""
    return make_unnamed_rig(*(camera(*look, **lens) for look in looks))


def around(target_m):
    return rig_of(*((centre_m, target_m) for centre_m in [(6, 0, 3), (-2, 5, 2), (-3, -5, 4)]))


#: Cameras beside each other that look away from each other, with lenses that distort.
OUTWARDS = rig_of(
    *(((np.cos(a), np.sin(a), 1.0), (9 * np.cos(a), 9 * np.sin(a), 1.0)) for a in (0.0, 2.1, 4.2)),
    focal_px=3000.0,
    dist=(-0.2, 0.05, 0.0, 0.0),
)
#: What it shows -> a rig, and whether views of its cameras meet.
RIGS = {
    "around": (around((0.0, 0.0, 1.5)), True),
    "side by side": (rig_of(((0, 0, 1), (0, 9, 1)), ((4, 0, 1), (4, 9, 1))), True),
    "back to back": (rig_of(((0, 1, 1), (0, 9, 1)), ((0, -1, 1), (0, -9, 1))), False),
    # Images of 3 m, 100 m away.
    "far": (rig_of(((-100, 0, 1), (0, 0, 1)), ((0, -100, 1), (0, 0, 1)), focal_px=6e4), True),
    "far above": (rig_of(((-100, 0, 1), (0, 0, 1)), ((0, -100, 21), (0, 0, 21)), focal_px=6e4), False),
    "outwards": (OUTWARDS, False),
}


@pytest.mark.parametrize(("rig", "meet"), RIGS.values(), ids=RIGS)
def test_whether_views_meet(rig, meet):
    assert views_meet(rig.cameras) == meet


@pytest.mark.slow
def test_tracks_from_cameras_that_stand_elsewhere_than_stated_are_refused(run_psotrack, tmp_path):
    """Detections by cameras that look at a room, with the calibration of cameras that look elsewhere."""
    folder, true = tmp_path / "recording", around((0.0, 0.0, 1.5))
    time_s = np.arange(FRAMES)[:, None] / 25.0 + 3.0 * np.arange(2)
    truth_m = np.stack([np.sin(time_s), np.cos(1.3 * time_s), 1.5 + 0.4 * np.sin(2 * time_s)], axis=-1)
    seen = {}
    for index, name in enumerate(true.names):
        centre = project(true.cameras[index], truth_m.reshape(-1, 3))[0] + 0.5
        boxes = np.concatenate([centre - 6, centre + 6], axis=1)
        seen[name] = Detections(np.repeat(np.arange(FRAMES), 2), boxes, np.ones(len(boxes)))
    record_detections(folder, seen, OUTWARDS)
    words = ("track", folder, "--method", "projection-lines", "--out", folder / "tracks.csv")

    def track():
        return run_psotrack(*words, "--cache", tmp_path / "cache")

    expected = "expected cameras of which two have a place in view together"
    assert_refused(track, expected, "found that no views of 0, 1, 2 meet", unchanged=folder)
    write_rig(folder / "rig.toml", around((0.0, 0.9, 2.5)), force=True)
    expected = f"detections of different cameras that meet in a place in 0 of {FRAMES} frames"
    assert_refused(track, expected, f"`psotrack doctor {folder}`", unchanged=folder)
