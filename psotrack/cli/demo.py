"""`psotrack demo`: simulate, track and evaluate once, without any data."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from psotrack.cli.commands import command
from psotrack.cli.options import Jobs, compiled_folder
from psotrack.cli.output import Output

#: Small enough for a laptop to do all in a minute, long enough for paths to be seen.
NAME, NUM_FRAMES, SCALE = "S02_D4_A", 75, 0.5


@command(without=["json_path"])
def demo(output: Output, *, out: Path = Path("psotrack-demo"), seed: int = 0, jobs: Jobs = None) -> None:
    """Simulate four drones, track them in eight videos, print the errors and save a picture.

    After an interruption, the next call keeps the simulated sequence and the silhouettes.

    \b
    Example:
      psotrack demo --out demo

    Options:
        out: folder of the results.
        seed: seed of flights, noise and swarm.
    """
    from psotrack.evaluation import evaluate, tables
    from psotrack.foreground.silhouettes import SilhouetteSettings
    from psotrack.pipeline import track_recording, with_real_time
    from psotrack.recordings.datasets import read_sequence
    from psotrack.settings import TrackSettings
    from psotrack.show.flights import flight_of, record_files, write_tracked
    from psotrack.show.overlay import save_picture
    from psotrack.simulation import SimulationSettings, simulate
    from psotrack.support import atomic_write, keep_compiled

    keep_compiled(compiled_folder(None))
    tracks, picture, force = out / "tracks.csv", out / "demo.png", output.force
    output.refuse(tracks, *record_files(tracks), picture)
    made: dict[str, Any] = {"jobs": jobs, "report": output.report}
    simulated = SimulationSettings(NUM_FRAMES, SCALE, seed, masks=False, onboard=False)
    folder = simulate(NAME, out, simulated, force=force, keep=not force, **made)
    began_s = time.perf_counter()
    recording = read_sequence(folder).usable()
    # Half the image size needs half the reduction, so that drones have the same number of silhouette pixels.
    settings = TrackSettings(seed=seed, silhouettes=SilhouetteSettings(reduction=2, working_reduction=1))
    tracked = track_recording(recording, settings, cache=out / "silhouettes", **made)
    record = with_real_time(tracked.record, time.perf_counter() - began_s)
    tracked = replace(tracked, record=record)
    assert recording.truth is not None, "the simulator writes one"
    errors = evaluate(tracked.trajectories, recording.truth)
    with atomic_write(picture) as picture_file:
        save_picture(picture_file, flight_of(tracked, recording))
        write_tracked(tracks, tracked, folder, force=force)
    output.say(*tables.as_text(errors, recording.name).splitlines())
    output.say(f"picture: {picture}")
    # A command of an environment that is not activated is typed with its path.
    program = "psotrack" if shutil.which("psotrack") else os.path.relpath(sys.argv[0])
    output.say(f"next: {program} view {tracks} {folder}")
