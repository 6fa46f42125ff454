"""Rigs in whose cameras' common view no drone can be found: one line says why, and what to do."""

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import make_unnamed_rig

from psotrack.cli import cli
from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, project, views_meet
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections, write_detections

K = np.array([[1000.0, 0, 960], [0, 1000.0, 540], [0, 0, 1]])
TELEPHOTO = np.array([[60_000.0, 0, 960], [0, 60_000.0, 540], [0, 0, 1]])
FRAMES = 40


def camera(centre_m, target_m, K=K, dist=()):
    R, t_m = look_at([float(x) for x in centre_m], [float(x) for x in target_m])
    return make_camera(R=R, t_m=t_m, K=K, dist=dist, image_size_wh=(1920, 1080))


def ring(centres_m, target_m=(0.0, 0.0, 1.5)):
    return make_unnamed_rig(*(camera(centre_m, target_m) for centre_m in centres_m))


def outwards(count):
    """Cameras beside each other that look away from each other, with lenses that distort."""
    angles = 2 * np.pi * np.arange(count) / count
    narrow = K * np.array([[3.0, 1, 1], [1, 3.0, 1], [1, 1, 1]])
    return make_unnamed_rig(
        *(
            camera(
                (np.cos(a), np.sin(a), 1.0),
                (9 * np.cos(a), 9 * np.sin(a), 1.0),
                narrow,
                (-0.2, 0.05, 0.0, 0.0),
            )
            for a in angles
        )
    )


def record(folder, stated, true, truth_m):
    """A recording of detections that the rig `true` saw, with the calibration `stated`."""
    write_rig(folder / "rig.toml", stated)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for index, name in enumerate(stated.names):
        frame = np.repeat(np.arange(len(truth_m)), truth_m.shape[1])
        centre = project(true.cameras[index], truth_m.reshape(-1, 3))[0] + 0.5
        write_detections(
            folder / f"{name}.csv",
            Detections(frame, np.concatenate([centre - 6, centre + 6], axis=1), np.ones(len(frame))),
        )
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', "size = [1920, 1080]", "fps = 25.0"]
    (folder / "recording.toml").write_text("\n".join(lines) + "\n")
    return folder


def refused(folder):
    words = ["track", str(folder), "--method", "projection-lines", "--out", str(folder / "tracks.csv")]
    with pytest.raises(InputError) as error:
        CliRunner().invoke(cli, [*words, "--cache", str(folder / "cache")], catch_exceptions=False)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("rig", "meet"),
    [
        (ring([(5, 0, 2), (0, 5, 2)]), True),
        # Side by side.
        (make_unnamed_rig(camera((0, 0, 1), (0, 9, 1)), camera((4, 0, 1), (4, 9, 1))), True),
        # Back to back.
        (make_unnamed_rig(camera((0, 1, 1), (0, 9, 1)), camera((0, -1, 1), (0, -9, 1))), False),
        # Images of 3 m that cross 100 m away.
        (
            make_unnamed_rig(
                camera((-100, 0, 1), (0, 0, 1), TELEPHOTO), camera((0, -100, 1), (0, 0, 1), TELEPHOTO)
            ),
            True,
        ),
        (
            make_unnamed_rig(
                camera((-100, 0, 1), (0, 0, 1), TELEPHOTO), camera((0, -100, 21), (0, 0, 21), TELEPHOTO)
            ),
            False,
        ),
        (outwards(3), False),
    ],
)
def test_whether_views_meet(rig, meet):
    assert views_meet(rig.cameras) == meet


def test_a_rig_whose_views_do_not_meet_is_refused(tmp_path):
    rig = outwards(3)
    message = refused(record(tmp_path, rig, rig, np.full((FRAMES, 1, 3), [9.0, 0.0, 1.0])))
    assert "expected cameras of which two have a place in view together" in message
    assert "found that no views of 0, 1, 2 meet" in message


@pytest.mark.slow
def test_detections_that_meet_nowhere_are_named(tmp_path):
    """The cameras stand elsewhere than stated."""
    true = ring([(6, 0, 3), (-2, 5, 2), (-3, -5, 4)])
    stated = ring([(6, 0, 3), (-2, 5, 2), (-3, -5, 4)], target_m=(0.0, 0.9, 2.5))
    time_s = np.arange(FRAMES)[:, None] / 25.0 + 3.0 * np.arange(2)
    truth_m = np.stack([np.sin(time_s), np.cos(1.3 * time_s), 1.5 + 0.4 * np.sin(2 * time_s)], axis=-1)
    message = refused(record(tmp_path, stated, true, truth_m))
    assert f"detections of different cameras that meet in a place in 0 of {FRAMES} frames" in message
    assert f"`psotrack doctor {tmp_path}`" in message
