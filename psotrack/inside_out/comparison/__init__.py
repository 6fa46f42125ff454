"""A camera's path against a reference, by the paper's procedure."""

from psotrack.inside_out.comparison.comparing import (
    PathComparison,
    Statistics,
    compare,
    mean_rotation,
    wrapped_deg,
)

__all__ = ["PathComparison", "Statistics", "compare", "mean_rotation", "wrapped_deg"]
