"""The doctor: does a rig agree with its own recording, before anybody tracks?

In: the rig, and detections or blobs of several cameras; optionally a reference. Out: a `Diagnosis` with findings,
each of which names a camera, pair or clock, says by how much it disagrees, and what to do.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
