"""Inside-out and outside-in as one track."""

from psotrack.inside_out.fusing.fused import Fused, FusedDrone, fuse

__all__ = ["Fused", "FusedDrone", "fuse"]
