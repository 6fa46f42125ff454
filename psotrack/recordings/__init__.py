"""Recordings: videos, the rig, detections and the reference, as one `Sequence`.

In: files of one recording (videos, detections, C3D). Out: a `Sequence` that says whether the files fit together,
decoded frames, detections, and reference trajectories made from motion-capture markers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
