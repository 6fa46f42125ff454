"""Files that hold a rig: the package's own rig.toml, the DPJAIT dataset's CSV, and the files of other programs.

In: the path of a file. Out: a `Rig` in metres, with x_cam = R X + t, or only its lenses. The format is recognised by
the content. Formats whose unit is open need it stated. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
