from .fused import FusedDrone, FusedTracks, fuse, write_fused

__all__ = ["FusedDrone", "FusedTracks", "fuse", "write_fused"]
