"""The cameras of a session: a name in the rig, a source of frames, and what is known of the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import InputError
from psotrack.geometry import chosen_cameras
from psotrack.live.recorder import CameraRecorder
from psotrack.live.sources import CameraStream, LiveSource, ReplayedVideo
from psotrack.recordings import Recording

#: Rate of a stream that does not tell its own, frames per second.
_USUAL_HZ = 25.0


@dataclass(frozen=True)
class LiveCamera:
    """A camera of a session.

    Attributes:
        name: name of the camera in the rig.
        source: source of its frames.
        fps: frames per second.
        line_time_s: time from row to row of a rolling shutter, seconds; 0 for a global shutter.
        ignore: image that is white where nothing counts as foreground; None for no such image.
        recorder: keeps the frames; None where they are not kept.
    """

    name: str
    source: LiveSource
    fps: float
    line_time_s: float = 0.0
    ignore: Path | None = None
    recorder: CameraRecorder | None = None


def live_cameras(
    recording: Recording,
    names: Sequence[str] | None = None,
    *,
    replay: bool,
    speed: float = 1.0,
    loops: int = 1,
) -> list[LiveCamera]:
    """The cameras of a recording that have a source of frames: streams and devices, or videos that are replayed.

    Args:
        recording: the recording.
        names: names of the cameras to use; None: all that have a source.
        replay: play the videos.
        speed: seconds of video per second.
        loops: how often the videos are played.

    Raises:
        InputError: fewer than two cameras have a source.
        SettingsError: a name fits no camera, or a camera is named twice.
    """
    rig = recording.rig if names is None else recording.rig.select(chosen_cameras(names, recording.rig.names))
    found = []
    for name, (width, height) in zip(rig.names, rig.cameras.image_size_wh.astype(int).tolist(), strict=True):
        camera = recording.by_name[name]
        video, times = camera.video, camera.times
        source: LiveSource
        if replay and video is not None and times is not None:
            source = ReplayedVideo(video, times.time_s, speed, loops)
        elif not replay and camera.stream is not None:
            source = CameraStream(camera.stream, (width, height))
        else:
            continue
        fps = times.fps if times is not None else _USUAL_HZ
        found.append(LiveCamera(name, source, fps, camera.line_time_s, camera.ignore))
    if len(found) < 2:
        what = "videos" if replay else "the address of a stream or the number of a device as `video`"
        expected, there = f"at least two cameras of the rig with {what}", [each.name for each in found]
        remedy = "" if replay else "--replay plays the videos of a recording"
        raise InputError(recording.folder, expected=expected, found=", ".join(there) or "none", remedy=remedy)
    return found
