"""From on-board video to a path: markers are detected in each frame, a pose is estimated, and a filter follows it.

In: a `FrameSource`, a `MarkerMap`, the lens and `LocaliseSettings`. Out: a `LocalisedVideo` with the filtered path, the
frames' own poses, and the time that each stage took. Other rooms use `localise_video`; `localise_frames` does the same
for markers that are detected already, and `pose_row` makes a frame of a path from one pose.

Imports go in this order: `records`, `corner_noise`, `frame_poses`, `map_evidence`, `video`.
"""

from psotrack.inside_out.line_time import LineTime, estimate_line_time
from psotrack.inside_out.localising.frame_poses import localise_frames, pose_row
from psotrack.inside_out.localising.records import STAGES, LocalisedVideo, LocaliseSettings
from psotrack.inside_out.localising.video import localise_video

__all__ = [
    "STAGES",
    "LineTime",
    "LocaliseSettings",
    "LocalisedVideo",
    "estimate_line_time",
    "localise_frames",
    "localise_video",
    "pose_row",
]
