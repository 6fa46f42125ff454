"""Recordings: videos, the rig, detections and the reference, as one `Recording`.

In: files of one recording (videos, detections, C3D). Out: a `Recording`, which checks that its files are consistent;
decoded frames, detections, and reference trajectories from motion-capture markers. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
