"""The pose of a camera from the markers in one frame.

In: corners of markers in the image (pixels) and in the world (metres), the lens and `PoseSettings`. Out: a
`MarkerPose` with its covariance and the probability that another pose is the right one. Other rooms use
`estimate_pose`, `estimate_noise` and these records, and nothing else of this room.

Imports go in this order: `equations` (the records, the linear equations of the corners, and the variances of a
recording); `estimating` (the estimation).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
