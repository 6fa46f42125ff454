"""`psotrack map-markers`: measure the positions of a room's markers, or check a table of them."""

from psotrack.cli.map_markers.command import FOUND, map_markers

__all__ = ["FOUND", "map_markers"]
