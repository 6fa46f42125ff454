"""Track initiation: where are drones that no track explains, and were they tracked before.

In: silhouettes, the rig, and the tracks so far. Out: the initial state of the drones in frame 0, candidates for new
tracks in each chunk of frames, and which lost track each candidate continues.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
