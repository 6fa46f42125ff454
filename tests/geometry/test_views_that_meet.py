"""Rigs in whose cameras' common view no drone can be found: one line says why, and what to do."""

import numpy as np
import pytest
from board_rigs import fly_point, record_detections
from helpers import assert_refused, make_unnamed_rig

from psotrack.geometry import look_at, make_camera, project, views_meet
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections

FRAMES = 40


def camera(centre_m, target_m, focal_px=1000.0, dist=()):
    R, t_m = look_at(centre_m, target_m)
    K = np.array([[focal_px, 0, 960], [0, focal_px, 540], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, dist=dist, image_size_wh=(1920, 1080))


def rig_of(centres_m, targets_m, **lens):
    """Cameras at places that look at targets."""
    cameras = [camera(*look, **lens) for look in zip(centres_m, targets_m, strict=True)]
    return make_unnamed_rig(*cameras)


def around(target_m):
    centres_m = [(6, 0, 3), (-2, 5, 2), (-3, -5, 4)]
    return rig_of(centres_m, [target_m] * 3)


#: Cameras beside each other that look away from each other, with lenses that distort.
ANGLE = np.array([0.0, 2.1, 4.2])
DIRECTIONS = np.stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros(3)], axis=-1)
#: Cameras beside each other that look away from each other, with lenses that distort.
OUTWARDS = rig_of(DIRECTIONS, 9 * DIRECTIONS, focal_px=3000.0, dist=(-0.2, 0.05, 0.0, 0.0))
#: Two cameras 100 m away from the middle, with images of 3 m there.
FAR_M = [(-100, 0, 1), (0, -100, 1)]
#: What it shows -> a rig, and whether views of its cameras meet.
#: What it shows -> a rig, and whether views of its cameras meet.
RIGS = {
    "around": (around((0.0, 0.0, 1.5)), True),
    "side by side": (rig_of([(0, 0, 1), (4, 0, 1)], [(0, 9, 1), (4, 9, 1)]), True),
    "back to back": (rig_of([(0, 1, 1), (0, -1, 1)], [(0, 9, 1), (0, -9, 1)]), False),
    "far": (rig_of(FAR_M, [(0, 0, 1), (0, 0, 1)], focal_px=6e4), True),
    "far, at two heights": (rig_of(FAR_M, [(0, 0, 1), (0, 0, 21)], focal_px=6e4), False),
    "outwards": (OUTWARDS, False),
}


@pytest.mark.parametrize(("rig", "meet"), RIGS.values(), ids=RIGS)
def test_whether_views_meet(rig, meet):
    assert views_meet(rig.cameras) == meet


@pytest.mark.slow
def test_tracks_from_cameras_that_stand_elsewhere_than_stated_are_refused(run_psotrack, tmp_path):
    """Detections by cameras that look at a room, with the calibration of cameras that look elsewhere."""
    folder = tmp_path / "recording"
    true = around((0.0, 0.0, 1.5))
    truth_m = fly_point(FRAMES)
    seen = {}
    for index, name in enumerate(true.names):
        centre_px, _ = project(true.cameras[index], truth_m)
        boxes = np.concatenate([centre_px - 6, centre_px + 6], axis=1)
        seen[name] = Detections(np.arange(FRAMES), boxes, np.ones(FRAMES))
    record_detections(folder, seen, OUTWARDS)
    words = ("track", folder, "--method", "projection-lines", "--out", folder / "tracks.csv")

    def track():
        return run_psotrack(*words, "--cache", tmp_path / "cache")

    expected = "expected cameras of which two have a place in view together"
    assert_refused(track, expected, "found that no views of 0, 1, 2 meet", unchanged=folder)
    write_rig(folder / "rig.toml", around((0.0, 0.9, 2.5)), force=True)
    expected = f"detections of different cameras that meet in a place in 0 of {FRAMES} frames"
    assert_refused(track, expected, f"`psotrack doctor {folder}`", unchanged=folder)
