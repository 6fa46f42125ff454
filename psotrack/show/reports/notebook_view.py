"""The 3D view of tracks in a notebook."""

from __future__ import annotations

from psotrack.pipeline import TrackedRecording
from psotrack.recordings import Recording
from psotrack.show.reports.scene import Scene3D, scene_of_tracks
from psotrack.trajectories import Trajectories


def view_3d(tracks: TrackedRecording | Trajectories, recording: Recording | None = None) -> Scene3D:
    """A view of tracks that turns and plays, for a notebook; a saved notebook keeps the view.

    Args:
        tracks: the result of `track`, or trajectories.
        recording: the recording, whose cameras and reference are shown; None shows the tracks alone.
    """
    trajectories = tracks.trajectories if isinstance(tracks, TrackedRecording) else tracks
    return scene_of_tracks(
        trajectories,
        truth=None if recording is None else recording.truth,
        rig=None if recording is None else recording.rig,
        size_m=tracks.size_m if isinstance(tracks, TrackedRecording) else None,
    )
