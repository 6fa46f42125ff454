"""A network that finds drones, trained on recordings whose drones are known.

In: recordings with masks or tracks of their drones, or a YOLO data set. Out: a model file (see
`psotrack.foreground.network`), which serves as background model and as detector. `samples` are the frames that the
network learns from, `variations` their random changes, `loss` what it learns, `steps` one step, `training` the whole.
Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
