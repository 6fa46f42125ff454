"""Simulation of sequences: from a scenario and a seed to videos, a calibration and ground truth.

In: a `Scenario` (a preset or a TOML file) and `SimulationSettings`. Out: a folder in the layout of the DPJAIT dataset,
which is read like a recorded sequence. The renderer draws 3D shapes. It does not use the boxes and the score of the
tracker, because shared code would hide mistakes of the tracker. Other rooms may use every name in `__init__.pyi`;
`psotrack simulate fly` also uses `flights.piloting`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
