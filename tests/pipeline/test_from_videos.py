"""From videos to tracks: thirty-two small cameras, and a camera that is knocked in mid-flight."""

import numpy as np
import pytest

from psotrack.evaluation import evaluate
from psotrack.pipeline import track_recording
from psotrack.recordings import VideoWriter, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate

NUM_CAMERAS = 32
#: The images have 480 x 270 pixels, in which a pixel is 17 mm at a distance of 5 m, where the drones are.
SCALE, PIXEL_M = 0.25, 0.017
#: Frame from which a camera is knocked, and how far its image moves.
KNOCKED, SHIFT_PX = 80, (3, 4)


@pytest.mark.nightly
def test_thirty_two_cameras_are_tracked_from_the_videos(tmp_path, run_psotrack):
    """Two commands make the silhouettes of half of the cameras each."""
    angle = 2 * np.pi * (np.arange(NUM_CAMERAS) + 0.5) / NUM_CAMERAS
    height_m = np.resize([2.2, 3.2], NUM_CAMERAS)
    place_m = np.stack([4.7 * np.cos(angle), 3.7 * np.sin(angle), height_m], axis=-1)
    cameras = [{"position_m": each, "target_m": [0.0, 0.0, 1.3]} for each in place_m.tolist()]
    recipe = change_scenario(scenario("S02_D4_A"), {"cameras": cameras})
    settings = SimulationSettings(scale=SCALE, num_frames=30, masks=False, onboard=False)
    folder = simulate(recipe, tmp_path, settings)
    recording = open_recording(folder).usable(num_frames=None)
    names, cache = recording.rig.names, tmp_path / "cache"
    assert len(names) == NUM_CAMERAS
    for half in (names[:16], names[16:]):
        words = ["detect", folder, "--silhouettes", "--cameras", ",".join(half), "--cache", cache]
        assert run_psotrack(*words).code == 0
    tracked = track_recording(recording, cache=cache)
    # No video was decoded again.
    assert tracked.record["seconds"]["decode"] == 0
    errors = evaluate(tracked.trajectories, recording.truth).to_dict()
    assert errors["drones"] == tracked.trajectories.num_drones == 4
    assert errors["missed_rate"] == 0
    # The score sees the middle of a drone's box, which is up to a pixel of these images from the origin of its body.
    # What is left when this offset of each drone is removed is noise: a silhouette's border is known to about a pixel,
    # and more than four cameras with independent noise see each drone.
    assert errors["mean_error_m"] < 1.5 * PIXEL_M
    assert errors["offset_removed_mean_error_m"] < PIXEL_M / np.sqrt(4)
    # Cameras on all sides: each drone is seen by most of them.
    assert np.median(tracked.trajectories.num_cameras) > NUM_CAMERAS / 2


@pytest.mark.slow
def test_a_camera_whose_video_moves_is_left_out_once(tmp_path, caplog):
    """It is left out from the knock on, once."""
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
