"""Live cameras: frames that meet by their times while they come, and the rows of tracks as they are found.

In: a rig and one source of frames per camera: a device, the address of a stream, or a video that is played at its own
rate. Out: the rows of each instant, and counts of what was lost. `sources` read frames, `front_end` turns them into
silhouettes in a thread for each camera, `meeting` brings the frames of all cameras together, `session` runs the
tracker, `messages` sends rows, `recorder` keeps the frames. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
