"""`psotrack onboard`: the drone's own camera, from markers in images to its path and the fusion with tracks."""

import click

from psotrack.cli.lazy import SETTINGS, LazyCommand, LazyGroup

#: Commands by name, as in `psotrack.cli`.
COMMANDS = {
    "detect": LazyCommand(
        "psotrack.cli.onboard.detect_markers:detect_markers",
        "Find the ArUco markers and AprilTags in IMAGES, and their corners.",
    ),
    "map": LazyCommand(
        "psotrack.cli.onboard.map_markers:map_markers",
        "Write the table of a room's marker corners from SOURCE, or check such a table.",
    ),
    "localise": LazyCommand(
        "psotrack.cli.onboard.localise:localise",
        "Find the position of the camera of VIDEO in every frame, from the ArUco markers that it sees.",
    ),
    "fuse": LazyCommand(
        "psotrack.cli.onboard.fuse:fuse",
        "Fuse INSIDE, paths of on-board cameras, with OUTSIDE, tracks of the same drones from static cameras.",
    ),
}


@click.group(cls=LazyGroup, lazy_commands=COMMANDS, context_settings=SETTINGS)
def onboard() -> None:
    """Localise drones by their own cameras, from ArUco markers of known place.

    \b
    Markers of a room:  psotrack onboard map walk.mp4 --known 7 --side 0.2 --camera lens.toml --out corners.csv
    Path of a camera:   psotrack onboard localise flight.mp4 --markers corners.csv --camera lens.toml
    With tracks:        psotrack onboard fuse dron1.csv dron2.csv tracks.csv --out fused.csv
    """
