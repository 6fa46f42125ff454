"""A network that finds drones, trained on recordings whose drones are known.

In: recordings with masks or tracks of their drones, or a YOLO data set. Out: a model file, which serves as background
model (the foreground of a video) and as detector (boxes), and is written as ONNX. `network` is the network, `loss` what
it learns, `samples` the frames that it learns from, `variations` their random changes, `training` the training,
`model_file` its file, `serving` its use. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
