"""From on-board video to a path: markers are detected in each frame, a pose is estimated, and a filter follows it.

In: a `FrameSource`, a `MarkerMap`, the lens and `LocaliseSettings`. Out: a `LocalisedVideo` with the filtered path, the
frames' own poses, and the time that each stage took. Other rooms use `localise_video`; `localise_frames` does the same
for markers that are detected already.

`frame_poses` has the poses frame by frame, `recording` all frames of a recording.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
