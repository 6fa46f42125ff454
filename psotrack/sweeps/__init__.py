"""Sweeps: track and evaluate with every combination of a grid of settings, and make tables of the results.

In: a grid (a TOML file or a mapping) and the sequences. Out: one stored result per cell of the grid, and pandas tables
of the results. An interrupted sweep continues where it stopped, and several processes and machines can share a sweep.
Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
