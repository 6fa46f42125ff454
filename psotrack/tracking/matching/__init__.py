"""Correspondence: which detections of several cameras are of the same drone (paper, figure 8), in float64.

In: detections of one frame in all cameras, and expected positions of drones. Out: `Matches`, groups of detections with
their 3D points. `Sightings` holds the boxes of a detector, or the blobs of silhouettes, in arrays.
Other rooms may use every name in `__init__.pyi`.

`match` searches for the assignment with the smallest total cost. A detection in a group costs its squared distance from
the projection of the group's point, in squared standard deviations. A detection in no group costs `UNEXPLAINED_COST`.
A group costs `NEW_GROUP_COST`, or the squared distance from the expected position of its drone. More than two
viewpoints must agree, because two rays nearly meet at some point even where there is no drone.

Searching all assignments is the multidimensional assignment problem, which takes exponential time. The search here
takes polynomial time: pairs of detections on each other's epipolar lines propose groups, exchanges that each lower the
cost choose among these groups, and optimal assignments of each camera's detections complete them. In small scenes,
where all assignments can be searched, the cost is hardly ever higher than the smallest cost.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
