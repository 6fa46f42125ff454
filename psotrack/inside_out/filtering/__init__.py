"""Poses followed over time: on the fly by a filter, and afterwards by a smoother."""

from psotrack.inside_out.filtering.pose_filter import PoseFilterParams, follow
from psotrack.inside_out.filtering.smoothing import smooth

__all__ = ["PoseFilterParams", "follow", "smooth"]
