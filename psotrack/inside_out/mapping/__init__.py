"""Maps of the markers in a room: built from videos, and checked against a video.

In: videos of a room with lenses, and what is known of a marker. Out: a `MarkerMap` with its uncertainty (`BuiltMap`),
or the faults of a map (`MapCheck`). Other rooms use these records with `build_map`, `check_map`, `complete_map`,
`find_sightings` and `corners_in_own_frame`.

Imports go in this order: `sightings` (markers in frames), `adjusting` (bundle adjustment), `initial_map`, `building`,
`checking`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
