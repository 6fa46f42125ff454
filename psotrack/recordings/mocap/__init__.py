"""Motion capture: files of C3D, and the flights of the bodies whose markers they hold.

In: a C3D file of markers, labelled or not. Out: `Markers`, and the `Trajectories` of the bodies: groups of
labels whose shape is learned from the recording. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
