"""`psotrack onboard`: the drone's own camera, from markers in images to its path and the fusion with tracks."""

import click

from psotrack.cli.lazy import LazyGroup

_COMMANDS = {
    "Commands": {
        "detect": "markers.detect_markers",
        "map": "markers.map_markers",
        "localise": "localise.localise",
        "fuse": "fuse.fuse",
    }
}


@click.group(cls=LazyGroup, package=__name__, below=_COMMANDS)
def onboard() -> None:
    """Localise drones by their own cameras, from ArUco markers of known place.

    \b
    Markers of a room:  psotrack onboard map walk.mp4 --known 7 --side 0.2 --camera lens.toml --out corners.csv
    Path of a camera:   psotrack onboard localise flight.mp4 --markers corners.csv --camera lens.toml
    With tracks:        psotrack onboard fuse dron1.csv dron2.csv tracks.csv --out fused.csv
    """
