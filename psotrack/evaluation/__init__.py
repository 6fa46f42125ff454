"""Evaluation: tracks judged by a reference.

In: two `Trajectories`. Out: an `Evaluation` with the figures of the contract, errors per frame, tables and plots.
Only trajectories come in, so every method is judged by the same code. No lower room imports this one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
