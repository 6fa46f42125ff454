"""Maps of the markers in a room: built from videos or from measured corners, and checked against a video.

In: videos of a room with lenses, or measured corners, and what is known of a marker. Out: a `MarkerMap` with its
uncertainty (`BuiltMap`), squares fitted to measured corners (`FittedSquares`), or the faults of a map (`MapCheck`).
Other rooms use these records with `build_map`, `fit_squares`, `check_map`, `read_measured_corners`, `find_sightings`
and `corners_in_own_frame`.

Imports go in this order: `sightings` (markers in frames), `square_fitting`, `adjusting` (bundle adjustment),
`initial_map`, `building`, `checking`.
"""

from psotrack.inside_out.mapping.building import BuiltMap, build_map, corners_in_own_frame

__all__ = ["BuiltMap", "build_map", "corners_in_own_frame"]
