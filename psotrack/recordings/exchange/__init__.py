"""Files of tracks in the formats of other programs: export, and the way back.

In: `Trajectories`, or a file or folder of TUM poses, KITTI poses, MOTChallenge 3D, C3D, MCAP with ROS 2 messages, CSV,
Parquet or JSON. Out: such files, with the names of what the format cannot hold; `Trajectories` again. Where a recording
is given, its cameras and images can be part of the export, and tracks that have times only get the frame numbers of the
recording's instants. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
