"""Recordings of which only the videos matter: a single video, or cameras whose lens or place is not known.

Silhouettes, blobs and a detector's boxes need no calibration. A camera without one gets a lens and a place that stand
in for its own, so that the same functions work on all recordings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psotrack.geometry import Camera, make_camera, make_rig
from psotrack.recordings.recording import Recording
from psotrack.recordings.video import VideoInfo


def recording_of_video(video: VideoInfo) -> Recording:
    """A recording of one camera with the name of the video's file, without its ending, or of the pictures' folder."""
    path = video.path.resolve()
    name = path.name if video.images else path.stem
    return Recording(name, path.parent, make_rig({name: _stand_in(video)}), {name: video})


def with_all_videos(recording: Recording) -> Recording:
    """The recording with a lens and a place for each camera that has a video; never to be used for positions."""
    names = [name for name in recording.unplaced if name in recording.videos]
    if not names:
        return recording
    placed = {name: recording.rig.cameras[index] for index, name in enumerate(recording.rig.names)}
    others = {name: _stand_in(recording.videos[name]) for name in names}
    unplaced = tuple(name for name in recording.unplaced if name not in names)
    return replace(recording, rig=make_rig(placed | others), unplaced=unplaced)


def _stand_in(video: VideoInfo) -> Camera:
    width, height = video.image_size_wh
    K = np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=(width, height))
