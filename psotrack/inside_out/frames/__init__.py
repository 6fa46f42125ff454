"""Frames of one camera, from a video file, a folder of images or a live stream.

In: a path, an address or a device. Out: a `FrameSource`, which describes the frames and reads them one by
one as `Frame` (number, time, image). Other rooms use `open_source`, `FrameSource`, `Frame`, and `read_ahead` and
`map_ahead`, which read frames, and work on them, in separate threads.

Imports go in this order: `records`, `image_folder`, `stream`, `opening`; `prefetch` stands alone.
"""

from psotrack.inside_out.frames.opening import open_source
from psotrack.inside_out.frames.prefetch import map_ahead, read_ahead
from psotrack.inside_out.frames.records import Frame, FrameSource

__all__ = ["Frame", "FrameSource", "map_ahead", "open_source", "read_ahead"]
