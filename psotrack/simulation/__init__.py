"""Simulated recordings: a scenario and a seed become videos, a calibration and the truth.

In: a `Scenario` (a preset or a TOML file) and a seed. Out: a folder in the layout of the DPJAIT dataset, which is
read like a recorded one. The renderer draws 3D shapes; it knows neither the boxes nor the score of the tracker, so it
cannot confirm their mistakes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
