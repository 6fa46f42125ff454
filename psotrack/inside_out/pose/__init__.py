"""The pose of a camera from one frame's markers."""

from psotrack.inside_out.pose.locating import Expected, MarkerPose, PoseSettings, locate

__all__ = ["Expected", "MarkerPose", "PoseSettings", "locate"]
