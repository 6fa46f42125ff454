"""Comparison of a camera's path with a reference, by the paper's procedure (Tables 7 and 8).

In: a `CameraPath`, and a `PathReference` with clocks of its own. Out: a `PathComparison` with
clock offsets, lever arm, and distances and angles in every frame; `plots` draws it. Others use `compare_paths`, its
results and `Statistics`; `visibility.visible_markers` says which markers a camera could see.

Imports go in this order: `clocks`, `comparing`, `plots`; `visibility` stands alone.
"""

from psotrack.inside_out.comparison.comparing import (
    OrientationComparison,
    PathComparison,
    PathReference,
    Statistics,
    compare_paths,
    mean_rotation,
    wrap_deg,
)

__all__ = [
    "OrientationComparison",
    "PathComparison",
    "PathReference",
    "Statistics",
    "compare_paths",
    "mean_rotation",
    "wrap_deg",
]
