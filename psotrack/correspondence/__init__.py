"""Correspondence: which detections of several cameras are of the same drone (paper, figure 8), in float64.

In: detections of one frame in all cameras, and where drones are expected. Out: `Matches`, groups of detections with
their 3D points.

The assignment of least total cost is sought. A detection in a group costs its squared distance, in standard
deviations, from the projection of the group's point; a detection in no group costs `UNEXPLAINED`; a group costs
`NEW`, or the squared distance from the position where a drone is expected. More than two viewpoints must agree,
because two rays nearly meet somewhere even where there is no drone.

Searching all assignments is the multidimensional assignment problem, which takes exponential time. Here pairs of
detections on each other's epipolar lines propose groups, exchanges that each lower the cost pack the groups, and
optimal assignments of each camera's detections complete them. This takes polynomial time, and in small scenes, where
all assignments can be searched, the cost is hardly ever higher than the least cost.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
