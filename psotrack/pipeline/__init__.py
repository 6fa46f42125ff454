"""The pipeline: from a recording to trajectories and a record, stage by stage.

In: a recording, settings, parts that the caller brings. Out: trajectories and a record of the run. Other rooms may use
every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
