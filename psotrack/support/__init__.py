"""General tools without knowledge of cameras or drones: files, text tables, settings files, processes, progress.

In: paths, text, callables. Out: checked values, files that are written completely or not at all, results of worker
processes. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
