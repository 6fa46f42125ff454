"""Recordings of which only the videos matter: a single video, or cameras whose lens or place is not known.

Silhouettes, blobs and a detector's boxes need no calibration. A camera without one gets a lens and a place that stand
in for its own, so that the same functions work on all recordings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psotrack.geometry import Camera, make_camera
from psotrack.recordings.camera_recording import CameraRecording
from psotrack.recordings.recording import Recording
from psotrack.recordings.video import VideoInfo


def recording_of_video(video: VideoInfo) -> Recording:
    """A recording of one camera with the name of the video's file, without its ending, or of the pictures' folder."""
    path = video.path.resolve()
    name = path.name if video.images else path.stem
    return Recording(name, path.parent, (CameraRecording(name, _stand_in(video), video),))


def with_all_videos(recording: Recording) -> Recording:
    """The recording with a lens and a place for each camera that has a video; never to be used for positions."""
    cameras = (
        replace(each, camera=_stand_in(each.video))
        if each.camera is None and each.video is not None
        else each
        for each in recording.cameras
    )
    return replace(recording, cameras=tuple(cameras))


def _stand_in(video: VideoInfo) -> Camera:
    width, height = video.image_size_wh
    K = np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=(width, height))
