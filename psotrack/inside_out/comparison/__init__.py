"""A camera's path against a reference, by the paper's procedure."""

from psotrack.inside_out.comparison.comparing import (
    Comparison,
    Statistics,
    compare,
    mean_rotation,
    wrapped_deg,
)

__all__ = ["Comparison", "Statistics", "compare", "mean_rotation", "wrapped_deg"]
