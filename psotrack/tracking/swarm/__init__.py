"""The tracker: a particle swarm that maximises the soft IoU of boxes and silhouettes, frame after frame.

In: coverage of the silhouettes, the rig, initial states and settings. Out: positions with covariances, velocities,
status and learned sizes, per frame and drone. The swarm and the score do not know each other; `tracker` combines
them. Other rooms may use every name in `__init__.pyi`.

The way of a frame: `recording` (offline) or `stepwise` (live) makes a `Block` of frames, and `Engine` (both in `block`)
takes the drones of a run, which are in slots, through it. `tracker.step` cuts windows (`patches`, `occlusion`),
searches (`search`, `optimiser`) for the largest score (`fitness`), refines the position (`vertex`), and measures the
drone (`moments`). What the rows do not explain is followed by `Births`; `run` begins, ends and re-identifies tracks.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
