"""Positions of drones over time, their files, and the association of estimated drones with reference drones.

In: arrays of positions, velocities, covariances and status. Out: `Trajectories`; CSV, Parquet and TUM files from which
the same numbers are read back; the estimated drone that belongs to each reference drone. Other rooms may use every name
in `__init__.pyi`, and the modules `association`, `resampling` and `tum`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
