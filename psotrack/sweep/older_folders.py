"""Results folders of version 0.1, whose settings were not nested: names of today, and keys of the older version.

Tracks are the same bit by bit, so results of version 0.1 are results of the same cell today. Only names differ:
`particles` is called `swarm.particles` today (see `settings.RENAMED`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import pandas as pd

from psotrack.settings import RENAMED, TrackSettings
from psotrack.sweep.cells import Cell, digest_cell
from psotrack.sweep.names import flatten, nest

#: Setting of version 0.1 that is gone, and the value that leaves the results as they are today.
_GONE = {"refinements": 0}

#: Settings that version 0.1 lacked, and the value that leaves the results as they were.
_NEW = {
    "swarm.search": "pso",
    "status.min_cameras_to_begin": None,
    "status.max_coasting_std_m": 0.5,
    "rate_hz": None,
    "clocks": "given",
    "errors.rig_deg": 0.0,
    "errors.pixel_px": 0.0,
    "silhouettes.background": "mog2",
    "silhouettes.drone_px": None,
    "silhouettes.first_look": True,
}

#: Values of version 0.1 for which the value is None today, where the data may say more.
_FROM_DATA = {"motion.max_speed_m_s": 6.0, "motion.jerk_density_m2_s5": 1.0}

#: Names of version 0.1, by today's name.
_OLDER_NAMES = {today: older for older, today in RENAMED.items() if today}


def rename_columns(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with today's names of settings as columns; rows of today do not change.

    A column of a setting that is gone is left out if all its values leave the results as they are today.
    """
    columns = {f"settings.{older}": f"settings.{today}" for older, today in RENAMED.items() if today}
    if not any(name in rows for name in columns):
        return rows
    gone = {f"settings.{name}": value for name, value in _GONE.items()}
    unused = [name for name, value in gone.items() if name in rows and (rows[name] == value).all()]
    new = {f"settings.{name}": value for name, value in _NEW.items()}
    return rows.drop(columns=unused).rename(columns=columns).assign(**new)


def rename_manifest(manifest: dict[str, Any]) -> dict[str, Any]:
    """Content of a manifest with today's names of settings in its grids."""
    return manifest | {"runs": [run | {"grid": _rename_grid(run["grid"])} for run in manifest["runs"]]}


def older_cell_key(cell: Cell, input_keys: Mapping[str, str]) -> str | None:
    """Key under which version 0.1 stored the results of a cell; None if version 0.1 could not run the cell.

    Args:
        cell: the cell.
        input_keys: digests of everything that the cell reads, as for `cells.cell_key`.
    """
    settings = _older_settings(cell.settings)
    return None if settings is None else digest_cell(cell, settings, input_keys)


def older_failure_name(cell: Cell) -> str | None:
    """Name under which version 0.1 stored the failure of a cell; None if version 0.1 could not run the cell."""
    return older_cell_key(cell, {"sequence": cell.sequence})


def _rename_grid(grid: Mapping[str, Any]) -> dict[str, Any]:
    methods = {name: _rename_keys(settings) for name, settings in grid["methods"].items()}
    return dict(grid) | {
        "settings": _rename_keys(grid["settings"]),
        "methods": methods,
        "axes": _rename_keys(grid["axes"]),
    }


def _rename_keys(values: Mapping[str, Any]) -> dict[str, Any]:
    return {RENAMED.get(name) or name: value for name, value in values.items()}


def _older_settings(settings: TrackSettings) -> dict[str, Any] | None:
    """Settings as nested tables with the names of version 0.1; None if that version lacked a setting that is used."""
    values = dict(flatten(msgspec.to_builtins(msgspec.structs.replace(settings, seed=0))))
    if any(values.pop(name) != value for name, value in _NEW.items()):
        return None
    values |= {name: value for name, value in _FROM_DATA.items() if values[name] is None}
    older = {_OLDER_NAMES.get(name, name): value for name, value in values.items()} | _GONE
    return nest(older, tuple(older))
