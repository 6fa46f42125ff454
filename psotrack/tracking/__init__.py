"""Tracking: from silhouettes or detections, and a rig, to the positions of drones in every frame.

In: the silhouettes or boxes of all cameras, the rig, and settings. Out: rows of positions with covariances, status and
identity. The rooms inside, lowest first:

- `motion`: the motion model, its Kalman filter and smoother.
- `matching`: which detections of several cameras are of the same drone.
- `births`: drones that have no track yet, and lost drones that come back.
- `swarm`: the particle swarm that maximises the overlap of boxes and silhouettes.
- `lines`: the projection lines, which triangulate detections.
- `camera_errors`: what the tracks show of the cameras' errors.
- `fusion`: the tracks of two methods as one set.
- `identity`: which track is which drone after drones met.
"""
