"""Evaluation: compare tracks with a reference.

In: two `Trajectories`, the estimate and the reference. Out: an `Evaluation` with the figures of the contract, errors
per frame, tables and plots. The input is only trajectories, so all methods are evaluated by the same code. A path with
orientations and clocks of its own is compared by `compare_paths`; `find_offset` finds the offset between two clocks.
Other rooms may use every name in `__init__.pyi`, and the modules `plots` and `tables`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
