"""Identity: tracks that may have exchanged their drones when they met, and the final labels.

In: tracks of a whole recording. Out: trajectories with resolved labels (`postprocessing`), and the encounters with
their probabilities.

Two drones that come near each other share silhouettes, and a tracker may give them each other's labels. While the
views do not separate them, every assignment of labels is kept with motion states of its own (`labellings`): the
motion before the encounter predicts, the measurements during and after it decide. A sudden exchange is a jump of both
tracks, a slow one a change of course that the motion model does not expect, and apparent sizes distinguish drones of
different size. When one assignment is nearly certain, it is applied from the frame on in which it makes the most
frames right.

Each decision uses only its frame and the frames before, and is final. So `resolve` of the first frames of a recording
gives the same result as `resolve` of the whole recording, up to the first frame of an encounter that is still open;
to go on from there it needs only the tracks.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
