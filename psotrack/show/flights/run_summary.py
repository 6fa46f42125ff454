"""What a whole run gave, from the files in its folder of results: for people, and for programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.calibration.clocks import reference_for
from psotrack.evaluation import Evaluation, evaluate
from psotrack.pipeline import speed_in_words
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.exchange import read_tracks
from psotrack.show.flights.run_record import read_run_record
from psotrack.support import html_block, html_lines, read_json
from psotrack.trajectories import Trajectories


@dataclass(frozen=True, repr=False)
class RunSummary:
    """What `psotrack run` gave; its text is what the command prints at the end.

    Attributes:
        name: name of the recording.
        results: folder of the results: `tracks.csv`, `report.html`, `doctor.json`, and `overlay` with the videos.
        trajectories: the tracks.
        record: the record of the run, as `track` writes it; empty where its file is gone.
        findings: what the doctor found, a sentence each.
        evaluation: errors; None where the recording has no reference.
    """

    name: str
    results: Path
    trajectories: Trajectories
    record: Mapping[str, Any]
    findings: tuple[str, ...]
    evaluation: Evaluation | None

    def to_dict(self) -> dict[str, Any]:
        """The numbers and the paths."""
        tracks, evaluation = self.trajectories, self.evaluation
        return {
            "recording": self.name,
            "drones": tracks.num_drones,
            "frames": tracks.num_frames,
            "seen": float(tracks.seen.mean()),
            "seconds": self.record.get("seconds", {}).get("total"),
            "real_time_factor": self.record.get("real_time_factor"),
            "camera_clocks": dict(self.record.get("camera_clocks", {})),
            "findings": list(self.findings),
            "mean_error_m": None if evaluation is None else evaluation.mean_error_m,
            "missed_rate": None if evaluation is None else evaluation.missed_rate,
            "tracks": str(self.results / "tracks.csv"),
            "report": str(self.results / "report.html"),
            "videos": str(self.results / "overlay"),
        }

    def __str__(self) -> str:
        lines = self._lines()
        width = max(map(len, lines))
        return "\n".join([self.name, *(f"  {label:<{width}}  {words}" for label, words in lines.items())])

    def __repr__(self) -> str:
        return f"RunSummary({self.name}: {self.trajectories.num_drones} drones; {self.results})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the same as a table."""
        return html_block(self.name, html_lines(self._lines()))

    def _lines(self) -> dict[str, str]:
        told, tracks = self.to_dict(), self.trajectories
        filmed_s = float(np.ptp(tracks.time_s))
        factor = told["real_time_factor"]
        speed = "" if not factor else f", {speed_in_words(factor)}"
        clocks = [f"{name} {1e3 * each['offset_s']:+.0f} ms" for name, each in told["camera_clocks"].items()]
        lines = {
            "drones": f"{tracks.num_drones}",
            "frames": f"{tracks.num_frames}, in {filmed_s:.1f} s; drones are seen in {told['seen']:.1%}",
            "tracked in": "not recorded" if told["seconds"] is None else f"{told['seconds']:.1f} s{speed}",
            "clocks": ", ".join(clocks) or "not corrected",
            "doctor": "; ".join(self.findings) or "nothing disagrees",
        }
        if self.evaluation is not None:
            lines["errors"] = f"{self.evaluation!r}".removeprefix("Evaluation(").removesuffix(")")
        return lines | {key: told[key] for key in ("tracks", "videos", "report")}


def run_summary(folder: Path | str) -> RunSummary:
    """What a whole run gave.

    Args:
        folder: folder of the recording, with its results.

    Raises:
        InputError: a file is missing, or cannot be read.
    """
    results, recording = Path(folder) / "results", open_recording(folder)
    path = results / "tracks.csv"
    tracks, record = read_tracks(path, recording=recording), read_run_record(path.with_suffix(".json"))
    found = read_json(results / "doctor.json").get("findings", [])
    evaluation = None
    if recording.truth is not None:
        evaluation = evaluate(tracks, reference_for(recording, tracks)[0])
    return RunSummary(
        recording.name,
        results,
        tracks,
        {} if record is None else record.whole,
        tuple(f"{each['message']}; {each['remedy']}" for each in found),
        evaluation,
    )
