"""Fusion of on-board paths (inside-out) with tracks of static cameras (outside-in), as one track per drone.

In: a `CameraPath` for each drone that carries a camera, and `Trajectories` of static cameras. Out: `FusedTracks`, with
the arm between camera and silhouette, and the scales of both sources' covariances for each drone. Other rooms use
`fuse`, its results, and `write_fused`.

`weighting` has one drone; `fused` says which track belongs to which drone, and has all drones and their table.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
