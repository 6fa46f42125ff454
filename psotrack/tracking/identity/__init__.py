"""Identity: find and resolve identity swaps, which happen when drones meet, and make the final trajectories.

In: tracks of a whole recording. Out: trajectories with resolved labels (`postprocessing`), and the encounters with
their probabilities. Other rooms may use every name in `__init__.pyi`.

Two drones that are near each other share silhouettes, and a tracker may swap their labels. An encounter is of two
drones (`encounters`): while the views do not separate them, both assignments of their labels have motion states of
their own (`labellings`). The motion before the encounter predicts, and the measurements during and after the encounter
decide. A sudden swap is a jump of both tracks; a slow swap is a change of course that the motion model does not expect.
When one assignment is nearly certain, it is applied from the frame from which it makes the most frames right. Three
drones that meet are three encounters: when one has exchanged labels, the others are followed anew (`resolving`).

Each decision uses only its frame and the frames before, and is final. So `resolve` of the first frames of a recording
gives the same result as `resolve` of the whole recording, up to the first frame of an encounter that is still open.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
