"""Estimate of the time that a grid will take: a simple model, scaled by the stored results."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from psotrack.errors import InputError, PsotrackError
from psotrack.sweep.cells import Cell, cell_key
from psotrack.sweep.inputs import Inputs, source_of
from psotrack.sweep.machine import provenance
from psotrack.sweep.store import Store

#: Rule of thumb, measured on two cores of an AMD EPYC, seconds: per frame of a run; per frame, particle, iteration,
#: drone and camera; per compiled program; and per million pixels of silhouettes on one core.
FRAME_S, WORK_S, COMPILE_S, MEGAPIXEL_S = 0.02, 0.8e-6, 10.0, 0.008


@dataclass(frozen=True)
class Estimate:
    """Rough estimate of the time that a grid will take, seconds.

    Attributes:
        cells: number of cells to run whose input can be read.
        unread: number of cells whose input cannot be read.
        tracking_s: time of all runs; a batch of runs is assumed to cost as much as the runs one by one.
        compiling_s: time of compiling; compiled programs that are stored already are included.
        silhouettes_s: time of making the silhouettes that are not stored.
        basis: origin of the numbers, in words.
        faults: why inputs cannot be read, each reason once.
    """

    cells: int
    unread: int
    tracking_s: float
    compiling_s: float
    silhouettes_s: float
    basis: str
    faults: tuple[str, ...] = ()

    @property
    def total_s(self) -> float:
        """Sum of all times."""
        return self.tracking_s + self.compiling_s + self.silhouettes_s

    def __str__(self) -> str:
        unread = f"; without {self.unread} cells whose input cannot be read" if self.unread else ""
        if not self.cells:
            return f"nothing to run{unread}"
        parts = (
            ("tracking", self.tracking_s),
            ("compiling", self.compiling_s),
            ("silhouettes", self.silhouettes_s),
        )
        listed = ", ".join(f"{name} {_in_words(seconds)}" for name, seconds in parts if seconds)
        total = f"about {_in_words(self.total_s)} for {self.cells} cells"
        return f"{total} ({listed}), estimated from {self.basis}{unread}"


def estimate(cells: Iterable[Cell], inputs: Inputs, store: Store | None) -> Estimate:
    """Estimate the time of the unfinished cells.

    Args:
        cells: cells of a grid.
        inputs: inputs of the cells.
        store: stored results, whose finished cells do not count, and whose times scale the model; None for no results.
    """
    factor, basis = _fit_factor(store)
    count = unread = 0
    tracking_s, programs, silhouettes_s = 0.0, set(), {}
    faults: dict[str, None] = {}
    for cell in cells:
        try:
            done = _finished_seeds(cell, inputs, store) if store else set()
            recording = inputs.recording_of(cell)
        except PsotrackError as error:
            unread += 1
            faults[str(error)] = None
            continue
        runs = len(set(cell.seeds) - done)
        if not runs:
            continue
        every = len(recording.rig)
        cameras = cell.cameras if isinstance(cell.cameras, int) else len(cell.cameras or range(every))
        assert recording.truth is not None
        drones = cell.settings.drones.count or recording.truth.num_drones
        settings = cell.settings
        count += 1
        swarm = settings.method != "projection-lines"
        work = settings.swarm.particles * settings.swarm.iterations * drones * cameras if swarm else 0
        tracking_s += factor * runs * recording.num_frames * (FRAME_S + WORK_S * work)
        shape = (
            settings.swarm.particles,
            settings.swarm.kind,
            settings.score.kind,
            settings.score.windows,
            settings.silhouettes.reduction,
        )
        if swarm:
            programs.add((cell.sequence, cameras, runs, shape))
        if settings.needs_silhouettes and source_of(cell) not in silhouettes_s:
            silhouettes_s[source_of(cell)] = _silhouettes_s(cell, inputs)
    return Estimate(
        count,
        unread,
        tracking_s,
        COMPILE_S * len(programs),
        sum(silhouettes_s.values(), 0.0),
        basis,
        tuple(faults),
    )


def _finished_seeds(cell: Cell, inputs: Inputs, store: Store) -> set[int]:
    """Seeds of a cell's finished runs."""
    return store.finished_seeds(cell_key(cell, inputs.keys_of(cell)))


def _in_words(seconds: float) -> str:
    """Format a time with few digits, because the estimate is rough."""
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit_s:.0f} {unit}"
    return f"{seconds / 86400:.0f} days"


def _fit_factor(store: Store | None) -> tuple[float, str]:
    """Median ratio of stored times to the rule of thumb, from this device if it has runs, and a description."""
    rule = "a rule of thumb, measured on two cores of an AMD EPYC"
    try:
        rows = store.rows() if store else pd.DataFrame()
    except InputError:
        rows = pd.DataFrame()
    needed = ("frames", "drones", "num_cameras", "seconds.track", "device.kind", "device.processor")
    if store is None or not set(needed) <= set(rows.columns):
        return 1.0, rule
    rows = rows.dropna(subset=list(needed))
    device = provenance()["device"]
    here = rows[(rows["device.kind"] == device["kind"]) & (rows["device.processor"] == device["processor"])]
    used, whose = (here, "this device") if len(here) else (rows, "another device")
    if used.empty:
        return 1.0, rule
    return float(
        np.median(used["seconds.track"] / _rule_s(used))
    ), f"{len(used)} runs on {whose} in {store.folder}"


def _rule_s(rows: pd.DataFrame) -> pd.Series:
    """Time of each row's run by the rule of thumb, seconds."""
    work = (
        rows["settings.swarm.particles"]
        * rows["settings.swarm.iterations"]
        * rows["drones"]
        * rows["num_cameras"]
    )
    return rows["frames"] * (FRAME_S + WORK_S * work)


def _silhouettes_s(cell: Cell, inputs: Inputs) -> float:
    """Time of making a cell's missing silhouettes, with all processes."""
    recording, keys = inputs.recording_of(cell), inputs.keys_of(cell)
    megapixels = [
        video.num_frames * video.image_size_wh[0] * video.image_size_wh[1] / 1e6
        for name, video in recording.videos.items()
        if not (inputs.cache / keys[name]).exists()
    ]
    jobs = min(inputs.jobs or os.cpu_count() or 1, max(len(megapixels), 1))
    return MEGAPIXEL_S * sum(megapixels) / jobs
