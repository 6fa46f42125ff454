"""`psotrack map-markers`: where a room's markers are, from motion capture or videos, and what is wrong with a map."""

from psotrack.cli.map_markers.command import FOUND, map_markers

__all__ = ["FOUND", "map_markers"]
