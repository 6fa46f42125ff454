"""The doctor: checks before tracking whether a rig agrees with its own recording.

In: the rig, and detections or blobs of several cameras; optionally a reference. Out: a `Diagnosis` with findings. Each
finding names a camera, a pair of cameras or a clock, and says how large the disagreement is and what to do.
Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
