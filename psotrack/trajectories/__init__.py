"""Positions of drones over time, and the files that hold them.

In: arrays of positions, velocities, covariances and status. Out: `Trajectories`, and CSV, Parquet and TUM files that
read back to the same numbers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
