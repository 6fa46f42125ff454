"""Sweeps: a grid of settings, tracked and evaluated cell by cell, and tables of the results.

In: a grid (a TOML file or a mapping) and the sequences. Out: one stored result per cell, so that an interrupted sweep
goes on where it stopped and several machines can share one, and pandas tables of the results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
