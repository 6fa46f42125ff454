"""Fusion of the tracks of two methods into one set of tracks, weighted by covariances.

In: tracks of the swarm and of the projection lines for the same frames, and the errors of the cameras that each method
shows. Out: the fused tracks with their errors, and for each drone the constant offset between the two tracked points.
Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
