"""Where the markers of a room are: their map from videos or from measured corners, and what is wrong with a map."""

from psotrack.inside_out.mapping.building import BuiltMap, build_map, own_frame

__all__ = ["BuiltMap", "build_map", "own_frame"]
