"""Results folders of version 0.1: the keys of their cells, and rows and manifests with older names of settings."""

from pathlib import Path

import pandas as pd
import pytest

from psotrack.errors import SettingsError
from psotrack.sweep import Store, cell_key, grid, pivot
from psotrack.sweep.cells import Cell
from psotrack.sweep.older_folders import older_cell_key, older_failure_name

INPUT_KEYS = {"cam1": "a" * 40, "calibration": "b" * 40}
KEY, OLDER_KEY = "0" * 40, "1" * 40


def one_cell(**changes: object) -> Cell:
    settings = {
        "swarm.particles": 8,
        "swarm.kind": "joint",
        "score.kind": "hard",
        "score.occlusion": False,
        "drones.size_m": [0.5, 0.5, 0.2],
        "identity.resolve_swaps": False,
        "silhouettes.background": "mog2",
        "silhouettes.reduction": 2,
        "silhouettes.working_reduction": 2,
        "silhouettes.min_blob_px": 64,
        **changes,
    }
    axes = {"cameras": [4], "motion.jerk_density_m2_s5": [2.0]}
    (cell,) = grid({"sequences": ["S01_D2_A"], "settings": settings, "grid": axes}).cells()
    return cell


def add(store: Store, key: str, rows: pd.DataFrame) -> None:
    rows = rows.assign(seed=range(len(rows)), cell=key)
    store.add(key, rows, pd.DataFrame({"seed": rows["seed"], "frame": 0, "error_m": 0.1}))


def test_older_keys_are_those_of_version_0_1() -> None:
    """The keys were computed by version 0.1, from a grid with the same values under its own names."""
    cell = one_cell()
    assert older_cell_key(cell, INPUT_KEYS) == "ed4526dbcab59683702d0d4fe767099c9c80741e"
    assert older_failure_name(cell) == "6f4dd4b7aba02a71f7c3a1c206d8f40e47ff10ec"
    assert older_cell_key(cell, INPUT_KEYS) != cell_key(cell, INPUT_KEYS)


def test_another_search_than_particle_swarms_has_no_older_key() -> None:
    assert older_cell_key(one_cell(**{"swarm.search": "other"}), INPUT_KEYS) is None


def test_rows_have_todays_names(tmp_path: Path) -> None:
    """`swarm`, `score` and `drones` were settings in version 0.1, and are tables of settings today."""
    older = pd.DataFrame(
        {
            "mean_error_m": [0.2, 0.4],
            "settings.particles": 20,
            "settings.swarm": "joint",
            "settings.score": "soft",
            "settings.drones": 4,
            "settings.claims": True,
            "settings.refinements": 0,
            "settings.silhouettes.reduction": 4,
        }
    )
    today = pd.DataFrame(
        {
            "mean_error_m": [0.1, 0.3],
            "settings.swarm.particles": 50,
            "settings.swarm.kind": "joint",
            "settings.swarm.search": "pso",
            "settings.status.min_cameras_to_begin": None,
            "settings.status.max_coasting_std_m": 0.5,
            "settings.rate_hz": None,
            "settings.clocks": "given",
            "settings.errors.rig_deg": 0.0,
            "settings.errors.pixel_px": 0.0,
            "settings.score.kind": "soft",
            "settings.drones.count": 4,
            "settings.score.occlusion": True,
            "settings.silhouettes.reduction": 4,
            "settings.silhouettes.background": "mog2",
            "settings.silhouettes.drone_px": None,
            "settings.silhouettes.first_look": True,
        }
    )
    store = Store(tmp_path)
    add(store, OLDER_KEY, older)
    add(store, KEY, today)
    rows = store.rows()
    assert set(rows.columns) == {*today.columns, "seed", "cell"}
    names = ("status.min_cameras_to_begin", "rate_hz", "silhouettes.drone_px")
    of_no_value = [f"settings.{name}" for name in names]
    assert rows[of_no_value].isna().all(axis=None)
    assert not rows.drop(columns=of_no_value).isna().any(axis=None)
    shown = pivot(rows, rows_by=["particles"], columns_by=[], value="mean_error_m")
    assert shown.index.tolist() == [20, 50]
    assert shown["mean"].tolist() == pytest.approx([0.3, 0.2])
    assert store.rows({OLDER_KEY: [1]})["mean_error_m"].tolist() == [0.4]
    with pytest.raises(SettingsError, match=r"found claims; it is called score\.occlusion today"):
        pivot(rows, rows_by=["claims"], columns_by=[], value="mean_error_m")


def test_a_setting_that_is_gone_stays_visible_where_it_changed_the_results(tmp_path: Path) -> None:
    add(Store(tmp_path), OLDER_KEY, pd.DataFrame({"settings.particles": [20], "settings.refinements": 5}))
    assert Store(tmp_path).rows()["settings.refinements"].tolist() == [5]


def test_manifests_have_todays_names(tmp_path: Path) -> None:
    older = {
        "settings": {"swarm": "joint"},
        "methods": {"calm": {"inertia": 0.4}},
        "axes": {"particles": [8, 9]},
    }
    store = Store(tmp_path)
    store.change_manifest(lambda manifest: manifest["runs"].append({"grid": older, "cells": 2}))
    (run,) = store.manifest()["runs"]
    assert run == {
        "grid": {
            "settings": {"swarm.kind": "joint"},
            "methods": {"calm": {"swarm.inertia": 0.4}},
            "axes": {"swarm.particles": [8, 9]},
        },
        "cells": 2,
    }
