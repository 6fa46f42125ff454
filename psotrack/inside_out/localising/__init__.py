"""From on-board video to a path: markers are detected in each frame, a pose is estimated, and a filter follows it.

In: a `FrameSource`, a `MarkerMap`, the lens and `LocaliseSettings`. Out: a `LocalisedVideo` with the filtered path, the
frames' own poses, and the time that each stage took. Other rooms use `localise_video`; `localise_frames` does the same
for markers that are detected already.

Imports go in this order: `records`, `frame_poses` (poses frame by frame), `recording` (all frames of a recording),
`video`.
"""

from psotrack.inside_out.line_time import LineTime, estimate_line_time
from psotrack.inside_out.localising.frame_poses import FollowedFrame, own_path
from psotrack.inside_out.localising.recording import localise_frames
from psotrack.inside_out.localising.records import STAGES, LocalisedFrames, LocalisedVideo, LocaliseSettings
from psotrack.inside_out.localising.video import localise_video

__all__ = [
    "STAGES",
    "FollowedFrame",
    "LineTime",
    "LocaliseSettings",
    "LocalisedFrames",
    "LocalisedVideo",
    "estimate_line_time",
    "localise_frames",
    "localise_video",
    "own_path",
]
