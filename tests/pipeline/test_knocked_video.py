"""A camera with a video is knocked in mid-flight: it is left out from then on, once."""

import numpy as np
import pytest

from psotrack.evaluation import evaluate
from psotrack.pipeline import track_recording
from psotrack.recordings import VideoWriter, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, simulate

KNOCKED, SHIFT_PX = 80, (3, 4)


@pytest.mark.slow
def test_a_camera_whose_video_moves_is_left_out_once(tmp_path, caplog):
    small = SimulationSettings(scale=0.25, num_frames=160, masks=False, onboard=False)
    folder = simulate("S02_D4_A", tmp_path, small)
    video = open_recording(folder).videos["cam3"]
    with VideoWriter(video.path, video.fps, video.image_size_wh) as moved:
        for number, frame in enumerate(list(read_frames(video))):
            moved.write(np.roll(frame, SHIFT_PX, axis=(0, 1)) if number >= KNOCKED else frame)
    recording = open_recording(folder).usable()
    tracked = track_recording(recording, cache=tmp_path / "cache")
    (knock,) = tracked.record["knocks"]
    assert (knock["camera"], knock["left_out"]) == ("cam3", True)
    # For some frames the whole image differs from the background, and they are left out.
    assert 0 <= knock["frame"] - KNOCKED <= 15
    np.testing.assert_allclose(knock["shift_px"], SHIFT_PX[::-1], atol=1.5)
    assert caplog.text.count("was knocked at frame") == 1
    assert evaluate(tracked.trajectories, recording.truth).to_dict()["missed_rate"] == 0
