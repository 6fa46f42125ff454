"""A video that shows the scene late is called late by the doctor, by the clocks of the tracks, and by `synchronise`."""

import numpy as np
import pytest
from test_camera_times import FPS, RIG, alike, make_timeline, positions, sightings_of, tracked

from psotrack.calibration.clocks import ReferenceOffset, camera_offsets, clocks_of_tracks
from psotrack.calibration.doctor import examine
from psotrack.evaluation import find_offset
from psotrack.geometry import project
from psotrack.recordings import FrameTimes
from psotrack.trajectories import Trajectories

#: Frames by which a video shows the scene late: its frame k shows what a video that is not late shows in frame k - 2.
LATE = 2.0
FRAMES = 150


@pytest.mark.parametrize("late", [LATE, -LATE])
def test_one_late_video_is_late_to_the_doctor_and_to_the_clocks_of_tracks(late):
    """The frames of the late video were exposed earlier than given, as a negative `time_offset_s` says."""
    shown = alike(FRAMES) | {RIG.names[3]: FrameTimes(FRAMES, FPS, -late / FPS)}
    sightings, timeline = sightings_of(shown), make_timeline(alike(FRAMES))
    word = "late" if late > 0 else "early"

    diagnosis = examine(RIG, sightings, fps=FPS)
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.cameras) == ("clock", (RIG.names[3],))
    assert f" ms {word} (" in finding.message
    assert diagnosis.late_frames[3] == pytest.approx(late, abs=0.1)
    added_s = float(finding.remedy.split("add ")[1].split()[0])
    assert added_s == pytest.approx(-late / FPS, abs=0.1 / FPS)

    record = clocks_of_tracks(RIG, sightings, timeline, tracked(timeline)).record(RIG.names)[RIG.names[3]]
    assert record["late_s"] == pytest.approx(late / FPS, abs=0.1 / FPS)
    assert record["offset_s"] == -record["late_s"]


def test_one_late_video_is_late_to_the_offsets_of_cameras():
    time_s = np.arange(FRAMES) / FPS
    points_px = np.stack(
        [
            project(RIG.cameras[index], positions(time_s - (LATE / FPS if index == 3 else 0.0)))[0]
            for index in range(len(RIG))
        ],
        axis=2,
    )
    late = -camera_offsets(RIG, points_px, FPS).offset_frames
    assert late[3] - np.median(late) == pytest.approx(LATE, abs=0.05)


@pytest.mark.parametrize("late", [LATE, -LATE])
def test_videos_that_are_all_late_are_late_to_synchronise(late):
    """Tracks of late videos have the positions of an earlier time of the reference."""
    frame = np.arange(FRAMES)
    estimate = Trajectories(frame, frame / FPS, ("0", "1"), positions((frame - late) / FPS))
    time_s = np.arange(-1.0, FRAMES / FPS + 1.0, 0.01)
    offset = find_offset(estimate, time_s, positions(time_s), max_offset_s=0.5)
    assert offset.offset_s == pytest.approx(-late / FPS, abs=1e-3)
    said = str(ReferenceOffset("flight", offset, {}, FPS, "world"))
    assert f"the videos show the scene {'late' if late > 0 else 'early'};" in said
    assert f"{'behind' if late > 0 else 'ahead of'} the videos'" in said
