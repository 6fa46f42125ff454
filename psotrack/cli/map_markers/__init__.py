"""`psotrack map-markers`: measure the positions of a room's markers, or check a table of such positions."""

from psotrack.cli.map_markers.command import FOUND, map_markers

__all__ = ["FOUND", "map_markers"]
