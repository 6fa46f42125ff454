"""The paper's other outside-in method: drones from the lines of sight of their detections, followed over time.

Frame after frame the motion model says where drones are expected; the sightings of all cameras are matched with them
and with each other, and triangulated (`crossings`); what comes of it corrects the motion model. What nobody expected
and is there in several frames is a drone, a new one or one that was lost.

Motion model, status and covariances are those of the swarm's tracker, and so are the results.
"""

from psotrack.projection_lines.following import follow
from psotrack.projection_lines.results import start_of

__all__ = ["follow", "start_of"]
