"""The tracker: a particle swarm that maximises the soft IoU of boxes and silhouettes, frame after frame.

In: coverage of the silhouettes, the rig, initial states and settings. Out: positions with covariances, velocities,
status and learned sizes, per frame and drone. The swarm and the score do not know each other; `tracker` combines
them. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
