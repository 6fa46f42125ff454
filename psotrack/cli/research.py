"""`psotrack detect`, `sweep` and `cache`: what cameras show of drones, grids of settings, and what is stored."""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from msgspec import Meta
from msgspec.structs import replace

from psotrack import recordings, support, sweeps
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import (
    Cache,
    Extent,
    Jobs,
    Seq,
    beside,
    cache_folder,
    compiled_folder,
    filmed_recording,
)
from psotrack.cli.output import Output
from psotrack.cli.settings import TrackingSettings
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.foreground import detection
from psotrack.foreground.detection import DetectorSettings
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.settings import TrackSettings

if TYPE_CHECKING:
    from psotrack.foreground.silhouettes import CacheEntry


logger = logging.getLogger(__name__)

#: Image pixels per pixel in which masks are computed: all, because masks are looked at and compared pixel by pixel.
MASKS_REDUCTION = 1


@dataclass(frozen=True)
class DetectOptions:
    """What is written.

    Attributes:
        detector: "network", the network that comes with the package; a file of `psotrack train`; a YOLO network (v5 to
            v11) that was trained on drones, as ONNX; or the detector that an installed package adds under NAME.
        blobs: write the blobs of foreground instead of a network's detections.
        silhouettes: compute and store the silhouettes, which `track` reads.
        masks: write the foreground of every frame at the size of the video, 0 to 255: as FOLDER/CAMERA/000000.png and
            so on, or as one video (.mp4, or .avi without loss).
    """

    detector: Annotated[str | None, says(metavar="network|FILE|NAME")] = None
    blobs: bool = False
    silhouettes: bool = False
    masks: Annotated[Path | None, says(metavar="FOLDER|FILE.mp4")] = None


@command()
def detect(
    output: Output,
    sequence: Seq,
    *,
    what: DetectOptions,
    out: Path | None = None,
    network: Annotated[DetectorSettings, OptionGroup("With --detector")],
    settings: Annotated[
        dict[str, Any],
        TrackingSettings(
            usual=("silhouettes.background", "silhouettes.drone_px"), part="silhouettes.", files=False
        ),
    ],
    extent: Extent,
) -> None:
    """Detect the drones of SEQ in each of its videos as 2D boxes: with a neural network, or as blobs of foreground.

    Writes OUT/CAMERA.csv for every camera, in the layout of the dataset's dl_data; `track --detections OUT` reads them.
    SEQ may also be a single video or a folder of pictures, without any calibration; CAMERA is then its name.

    --blobs takes what moves in a still image, as `track --detections blobs` does; boxes end at pixels of the image that
    the background model sees, unless --reduction is given. --silhouettes and --masks write the foreground itself.
    Silhouettes are stored under a key of the video's content, all settings and the background model: a second call
    finds them.

    \b
    Examples:
      psotrack detect my_lab --blobs
      psotrack detect my_lab --detector network --confidence 0.4
      psotrack detect my_lab --detector drones.onnx --out boxes --size 1280 --confidence 0.4
      psotrack detect pictures/ --blobs --out boxes --min-blob 16
      psotrack detect my_lab --silhouettes --frames 100 --json -
      psotrack detect flight.mp4 --masks flight_mask.mp4

    Options:
        out: folder of the detections. None: SEQ/results/detections.
    """
    wanted = {f"--{name}": value for name, value in vars(what).items()}
    given = [name for name, value in wanted.items() if value]
    if len(given) != 1:
        raise SettingsError(
            "detect", expected=f"one of {', '.join(wanted)}", found=" and ".join(given) or "none of them"
        )
    recording = filmed_recording(sequence, extent)
    if what.masks is not None:
        _write_masks(output, recording, what.masks, settings, extent)
    elif what.silhouettes:
        _store(output, recording, _silhouettes(settings), extent)
    elif what.blobs:
        _write(output, sequence, recording, out, _by_blobs(output, recording, _silhouettes(settings), extent))
    else:
        _write(output, sequence, recording, out, _by_network(output, recording, f"{what.detector}", network))


def _silhouettes(settings: dict[str, Any]) -> SilhouetteSettings:
    return TrackSettings().changed(settings).silhouettes


def _write(
    output: Output, sequence: Path, recording: recordings.Recording, out: Path | None, found: Any
) -> None:
    """Write the boxes of each camera as they are found."""
    out = out or beside(sequence, "detections")
    files = {name: out / f"{support.check_file_name(name, sequence)}.csv" for name in recording.videos}
    output.refuse(*files.values())
    counts: dict[str, int] = {}
    for name, detections in found:
        recordings.write_detections(files[name], detections)
        counts[name] = len(detections)
    if not any(counts.values()):
        logger.warning(
            "%s: not a box in the whole recording; does --detector find drones, at its --size?", out
        )
    frames = sum(video.num_frames for video in recording.videos.values())
    output.json({"out": str(out), "frames": recording.num_frames, "detections": counts})
    per_frame = sum(counts.values()) / frames
    output.say(
        f"{out}: {len(counts)} cameras, {recording.num_frames} frames, {per_frame:.2f} boxes per frame and camera"
    )


def _by_network(
    output: Output, recording: recordings.Recording, chosen: str, network: DetectorSettings
) -> Any:
    """Detections of each camera by a network, one camera after the other."""
    detector = detection.find_detector(chosen, network)
    for name, video in recording.videos.items():
        yield name, detection.detect_drones(detector, name, video, report=output.report)


def _by_blobs(
    output: Output, recording: recordings.Recording, settings: SilhouetteSettings, extent: Extent
) -> Any:
    """Detections of each camera by the blobs of its silhouettes."""
    import numpy as np

    from psotrack.foreground.silhouettes import blob_detections, compute

    sizes_wh = [video.image_size_wh for video in recording.videos.values()]
    if settings.reduction is None:
        # The boxes are as fine as the images allow, not as coarse as the tracker can do with.
        working = settings.scaled(sizes_wh).working_reduction
        settings = replace(settings, reduction=working, working_reduction=working)
    made = compute(recording, settings, cache=extent.silhouettes, jobs=extent.jobs, report=output.report)
    sizes = np.array([recording.videos[name].image_size_wh for name in made.cameras], float)
    yield from blob_detections(made, sizes, output.report).items()


def _store(
    output: Output, recording: recordings.Recording, settings: SilhouetteSettings, extent: Extent
) -> None:
    """Compute and store silhouettes."""
    from psotrack.foreground.silhouettes import compute

    where = extent.silhouettes
    stored = compute(recording, settings, cache=where, jobs=extent.jobs, report=output.report)
    output.json(
        {
            "cache": str(where),
            "keys": dict(stored.keys),
            "frames": stored.num_frames,
            "shape": list(stored.shape),
            "seconds": dict(stored.seconds),
        }
    )
    made = "made" if any(stored.seconds.values()) else "already there"
    output.say(f"{len(stored.cameras)} cameras, {stored.num_frames} frames: {made}, in {where}")


def _write_masks(
    output: Output, recording: recordings.Recording, out: Path, settings: dict[str, Any], extent: Extent
) -> None:
    """Write the masks of all cameras, whose stored size plays no part."""
    from psotrack.foreground.silhouettes import write_masks

    working = settings.get("silhouettes.working_reduction", MASKS_REDUCTION)
    sizes = {"silhouettes.working_reduction": working, "silhouettes.reduction": working}
    places = write_masks(
        recording,
        _silhouettes(settings | sizes),
        out,
        jobs=extent.jobs,
        force=output.force,
        report=output.report,
    )
    frames = {name: recording.videos[name].num_frames for name in places}
    output.json({"masks": frames, "files": {name: str(path) for name, path in places.items()}})
    output.say(f"{out}: {sum(frames.values())} masks of {len(places)} cameras")


@command()
def sweep(
    output: Output,
    grid_file: Annotated[Path | None, says(metavar="[GRID.toml]")] = None,
    *,
    out: Path | None = None,
    data: Path = Path("data"),
    dry_run: bool = False,
    status: Annotated[Path | None, says(metavar="DIR")] = None,
    cluster: Annotated[str | None, says(metavar="local|ADDRESS")] = None,
    workers: Annotated[int, Meta(ge=1)] | None = None,
    device: Literal["cpu", "gpu"] | None = None,
    cache: Cache = None,
    jobs: Jobs = None,
) -> None:
    """Track with every combination of a grid's settings, and keep one row per run.

    A cell is one combination of settings; its runs, which differ in their seeds, are tracked as one batch. The same
    command continues an interrupted sweep: finished cells are not run again. Several commands at the same time share
    the work. If a cell fails, its error is stored, the other cells run, and the exit code is 2.

    \b
    Examples:
      psotrack sweep grid.toml --dry-run
      psotrack sweep grid.toml --data data --out results
      psotrack sweep grid.toml --data data --out results --cluster tls://10.0.0.5:8786
      psotrack sweep --status results
      psotrack report results --table --rows particles --columns iterations --value mean_error_m

    Options:
        out: folder of the results; it is made if it does not exist. None: beside GRID.toml, named GRID_results.
        data: root folder of the sequences that the grid names.
        dry_run: print the cells and the number of runs without running a cell.
        status: print the numbers of finished, failed and locked cells in DIR and the processes at work; run nothing.
        cluster: run the cells on a Dask cluster: local starts a cluster on this machine; ADDRESS names a running
            scheduler.
        workers: number of processes of --cluster local. None: one per processor; one with --device gpu.
        device: device that computes. None: JAX's choice.
    """
    if status is not None:
        _status(output, status)
        return
    if grid_file is None:
        raise SettingsError("sweep", expected="GRID.toml or --status DIR", found="neither")
    if workers is not None and cluster is None:
        raise SettingsError("--workers", expected="--cluster local", found="no --cluster")
    from psotrack import sweeps

    def say(address: str) -> None:
        if not output.quiet:
            click.echo(f"the cluster listens at {address}, for programs on this computer only", err=True)

    cache = cache_folder(cache)
    grid = sweeps.read_grid(grid_file)
    out = out or grid_file.with_name(f"{grid_file.stem}_results")
    if dry_run:
        inputs = sweeps.Inputs(data, cache, jobs)
        output.result(sweeps.plan(grid, inputs, sweeps.Store(out)))
        return
    if cluster is not None:
        support.use_device("cpu")  # This process computes nothing, and must not take a GPU from the workers.
    else:
        support.share_processors()
        if device is not None:
            support.use_device(device)
        support.keep_compiled(compiled_folder(cache))
    at = None if cluster is None else sweeps.Cluster(cluster, workers, device, say)
    outcome = sweeps.sweep(grid, out, data=data, cache=cache, jobs=jobs, cluster=at, progress=output.report)
    output.result(outcome)
    if outcome.count("failed"):
        sys.exit(2)


def _status(output: Output, folder: Path) -> None:
    """Print the numbers of finished, failed and locked cells in a folder, and the processes at work."""
    content = sweeps.Store(folder).status()
    output.json(content)
    for failure in content["errors"]:
        output.say(f"failed: {failure}")
    for worker in content["at_work"]:
        output.say(f"at work: {worker}")
    words = {"finished": "finished", "failed": "failed", "claimed": "locked"}
    numbers = ", ".join(f"{content[key]} {word}" for key, word in words.items())
    output.say(f"{folder}: {numbers}")


@command(without=["progress"])
def cache(
    output: Output,
    *,
    older_than: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="DAYS")] = None,
    max_gb: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="GB")] = None,
    empty: bool = False,
    cache: Cache = None,
) -> None:
    """List, prune and empty the cache of silhouettes and compiled programs.

    The next run makes anew what is missing or damaged. A running command has read its silhouettes and is not disturbed.
    What psotrack did not put into the folder is left alone.

    \b
    Examples:
      psotrack cache
      psotrack cache --older-than 30 --max-gb 20
      psotrack cache --empty

    Options:
        older_than: remove entries that were not used for DAYS days.
        max_gb: then remove entries until the rest has at most GB gigabytes, those first that were used longest ago.
        empty: remove all entries.
    """
    from psotrack.foreground.silhouettes import choose_to_prune, list_entries, remove_entry

    folder, now_s = cache_folder(cache), time.time()
    entries = list_entries(folder)
    content: dict[str, Any] = {"cache": str(folder), "entries": [_described(each, now_s) for each in entries]}
    if older_than is None and max_gb is None and not empty:
        output.json(content)
        rows = (
            (each.path.name, each.video, f"{each.size_bytes / 1e6:.1f}", f"{_days(each, now_s):.1f}")
            for each in entries
            if each.kind == "silhouettes"
        )
        output.table(("silhouettes", "video", "MB", "days unused"), rows)
        output.say(f"{folder}: {_counted(entries)}")
        return
    max_bytes = None if max_gb is None else 1e9 * max_gb
    chosen = entries if empty else choose_to_prune(entries, now_s, older_than, max_bytes)
    for each in chosen:
        remove_entry(each)
    output.json({**content, "removed": [str(each.path) for each in chosen]})
    output.say(f"{folder}: removed: {_counted(chosen)}")


def _counted(entries: list[CacheEntry]) -> str:
    kinds = [each.kind for each in entries]
    size_mb = sum(each.size_bytes for each in entries) / 1e6
    return f"silhouettes of {kinds.count('silhouettes')} videos, {kinds.count('program')} programs, {size_mb:.1f} MB"


def _days(entry: CacheEntry, now_s: float) -> float:
    return max(0.0, now_s - entry.used_s) / (24 * 3600)


def _described(entry: CacheEntry, now_s: float) -> dict[str, Any]:
    return {
        "path": str(entry.path),
        "kind": entry.kind,
        "video": entry.video,
        "size_bytes": entry.size_bytes,
        "days_unused": round(_days(entry, now_s), 3),
    }
