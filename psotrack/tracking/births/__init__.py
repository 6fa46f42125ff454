"""Track initiation and re-identification: find drones that have no track, and find lost drones again.

In: silhouettes, the rig, and the tracks so far. Out: the initial state of the drones in frame 0, candidates for new
tracks in each chunk of frames, and the assignment of candidates to lost tracks. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
