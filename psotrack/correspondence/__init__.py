"""Which detections of several cameras are of the same drone, by epipolar geometry (paper, figure 8), in float64.

The assignment with the least total cost is sought: a detection in a group costs its squared distance from where the
group's point is seen, in standard deviations; one in no group costs `UNEXPLAINED`; a group costs `NEW`, or the squared
distance from where a drone is expected. More than two viewpoints must agree, because any two rays nearly meet
somewhere, often enough where there is nothing.

To search all assignments is the multidimensional assignment problem, which takes exponential time. Here groups are
proposed by pairs of detections on each other's epipolar lines, packed by exchanges that each lower the cost, and
completed by optimal assignments of each camera's detections. That is polynomial, and in small scenes, where all can be
searched, hardly ever more than the least.
"""

from psotrack.correspondence.epipolar import epipolar_distance
from psotrack.correspondence.groups import NEW, SHARED, UNEXPLAINED
from psotrack.correspondence.matching import Matches, match
from psotrack.correspondence.packing import SEPARATION_M

__all__ = ["NEW", "SEPARATION_M", "SHARED", "UNEXPLAINED", "Matches", "epipolar_distance", "match"]
