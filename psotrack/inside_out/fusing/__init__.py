"""Fusion of on-board paths (inside-out) with tracks of static cameras (outside-in), as one track per drone.

In: a `CameraPath` for each drone that carries a camera, and `Trajectories` of static cameras. Out: `FusedTracks`, with
the arm between camera and silhouette, and the scales of both sources' covariances for each drone. Other rooms use
`fuse`, its results, and `fused_table.write_fused`.

Imports go in this order: `sources` (both at the same frames), `pairing` (which track belongs to which drone),
`weighting` (one drone), `fused` (all drones), `fused_table`.
"""

from psotrack.inside_out.fusing.fused import FusedDrone, FusedTracks, fuse

__all__ = ["FusedDrone", "FusedTracks", "fuse"]
