"""Sweeps: track and evaluate with every combination of a grid of settings, and make tables of the results.

In: a grid (a TOML file or a mapping) and the sequences. Out: one stored result per cell of the grid, and pandas tables
of the results. An interrupted sweep continues where it stopped, and several processes and machines can share a sweep.
Other rooms may use every name in `__init__.pyi`.
"""

import sys as _sys
from types import ModuleType as _ModuleType
from typing import Any as _Any

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


class _Room(_ModuleType):
    """This room, which may be called: it stands at `psotrack.sweep` once it is loaded, instead of the function."""

    def __call__(self, *args: _Any, **kwargs: _Any) -> _Any:
        from psotrack.support import checked

        return checked(self.sweep)(*args, **kwargs)


_sys.modules[__name__].__class__ = _Room
