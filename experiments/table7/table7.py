"""The paper's Tables 6, 7 and 8 and figure 11: a drone's own camera and markers on the walls, against a reference.

    python experiments/table7/table7.py            # S01_D2_A and S02_D4_A, simulated if they are missing
    python experiments/table7/table7.py --data FOLDER_OF_THE_DATASET    # every sequence *_A in it

Every video is searched for markers once. The markers are kept in --out, and every method uses these markers: once
unchanged, and once with a share of them mistaken for other markers. Writes results.csv, table6.csv, table7.md and
pictures to --out. With --results, rows, table7.md, record and two pictures become the headline figure.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from _measures import ANGLES, Measures, measure, row, together
from _methods import paths
from _recordings import Recording, at_hand, recordings, simulated
from _sightings import Sightings, detected, mislabelled

from psotrack.errors import PsotrackError
from psotrack.evaluation import PathComparison, compare_paths
from psotrack.evaluation.plots import save_paths
from psotrack.inside_out import CameraPath
from psotrack.support import atomic_write

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

#: Pictures of the result -> their committed names in experiments/pictures.
PICTURES = {
    "paths_S02_D4_A_dron2.png": "table7_paths.png",
    "errors_S02_D4_A_dron2_2_percent_wrong.png": "table7_errors.png",
}
#: Shares of the markers that are mistaken for other markers.
WRONG = (0.0, 0.02)
KEYS = ["sequence", "drone", "wrong", "method"]
STATISTICS = ("mean", "median", "std", "minimum", "maximum")
#: Title -> columns, each with its heading, factor and decimals.
FIGURES = {
    "position_median_m": ("position, median (mm)", 1e3, 2),
    "position_p99_m": ("99th percentile (mm)", 1e3, 1),
    "position_max_m": ("maximum (mm)", 1e3, 1),
    "orientation_median_deg": ("orientation, median (degrees)", 1, 3),
    "posed_rate": ("frames with a pose", 1, 4),
    "inside_90_rate": ("true position in the 90 % ellipsoid", 1, 3),
}


#: A drone with a method, and the measures of the method.
Case = tuple[dict[str, object], Measures]
#: A row of Table 6, and the cases behind the other tables.
Flight = tuple[dict[str, object], list[Case]]


def main() -> None:
    """Simulate the sequences that are missing, find markers and poses, compare, and show the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, help="root folder of the sequences [default: simulated into OUT]"
    )
    parser.add_argument("--out", type=Path, default=Path("table7"))
    parser.add_argument("--results", type=Path, help="write rows and record into this folder")
    options = parser.parse_args()
    run = _results.Run("table7")
    errors: list[PsotrackError] = []
    try:
        data = options.data or simulated(options.out / "data")
        flown = [each for folder in at_hand(data) for each in flights(folder, options.out, errors)]
        if flown:
            show(flown, options.out)
            if options.results:
                for name, picture in PICTURES.items():
                    shutil.copy(options.out / name, options.results.with_name("pictures") / picture)
                shutil.copy(options.out / "table7.md", options.results)
                run.save(options.results, rows=pd.read_csv(options.out / "results.csv"))
    except PsotrackError as error:
        errors.append(error)
    if errors:
        sys.exit("\n".join(f"table7: {error}" for error in errors))


def flights(folder: Path, out: Path, errors: list[PsotrackError]) -> Iterator[Flight]:
    """All flights of a sequence. An error of one flight is appended to `errors`, and the next flight follows."""
    try:
        found = list(recordings(folder))
    except PsotrackError as error:
        errors.append(error)
        return
    for recording in found:
        try:
            yield flight(recording, out)
        except PsotrackError as error:
            errors.append(error)


def flight(recording: Recording, out: Path) -> Flight:
    """Localise one video by every method."""
    name = f"{recording.sequence}_{recording.drone}"
    seen = detected(recording, out / "detections" / f"{name}.npz")
    cases, described = [], {}
    for wrong in WRONG:
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        found = paths(recording, mislabelled(seen, wrong, recording.marker_map, rng))
        comparisons = {method: compared(recording, path) for method, path in found.items()}
        for method, path in found.items():
            key = dict(zip(KEYS, (recording.sequence, recording.drone, wrong, method), strict=True))
            one = comparisons[method]
            cases.append((key | clocks(recording, one), measure(recording, path, one)))
            print(
                f"{name}, {wrong:.0%} wrong, {method}: {1e3 * np.nanmean(one.distance_m):.1f} mm", flush=True
            )
        with_wrong = f"{wrong:.0%}".replace("%", "_percent_wrong")
        save_paths(out / f"errors_{name}_{with_wrong}.png", comparisons, force=True)
        if wrong == 0:
            described = description(recording, seen, found["paper"], comparisons["smoother"])
            title = f"{recording.sequence}, {recording.drone}: by the filter, and by the reference"
            save_paths(out / f"paths_{name}.png", {"filter": comparisons["filter"]}, title=title, force=True)
    return described, cases


def compared(recording: Recording, path: CameraPath) -> PathComparison:
    """Compare by the paper's procedure, which does not know the offsets of the clocks, as `psotrack evaluate` does."""
    return compare_paths(path.trajectories(recording.drone), recording.reference, recording.turns)


def clocks(recording: Recording, comparison: PathComparison) -> dict[str, float]:
    """Clock offsets that were found, and their errors in frames where the true offsets are known."""
    turning, planted_s = comparison.turning, recording.planted_s
    found = {
        "offset_s": comparison.offset_s,
        "orientation_offset_s": np.nan if turning is None else turning.offset_s,
    }
    if planted_s is not None:
        off = {f"{key}_off_frames": value for key, value in zip(found, planted_s, strict=True)}
        fps = recording.video.fps
        found |= {
            name: (found[name.removesuffix("_off_frames")] - value) * fps for name, value in off.items()
        }
    arm = {f"lever_arm_{axis}_m": part for axis, part in zip("xyz", comparison.lever_arm_m, strict=True)}
    return found | arm


def description(
    recording: Recording, seen: Sightings, path: CameraPath, comparison: PathComparison
) -> dict[str, object]:
    """The row of Table 6."""
    known = np.isin(seen.ids, recording.marker_map.ids)
    per_frame = np.bincount(seen.frame[known], minlength=path.num_frames)
    return {
        "sequence": recording.sequence,
        "drone": recording.drone,
        "frames": path.num_frames,
        "frames with a pose": int(path.seen.sum()),
        "markers in the map": len(recording.marker_map),
        "markers recognised": len(np.unique(seen.ids[known])),
        "markers per frame, median": float(np.median(per_frame)),
        "length (s)": path.num_frames / recording.video.fps,
        "path length (m)": comparison.path_length_m,
    }


def show(flown: list[Flight], out: Path) -> None:
    """Print the tables, and write them and the rows."""
    described, cases = (
        pd.DataFrame([one for one, _ in flown]),
        [case for _, of_one in flown for case in of_one],
    )
    rows = pd.DataFrame([key | row(measures) for key, measures in cases])
    pooled = pd.DataFrame([key | row(measures) for key, measures in of_sequences(cases)])
    pd.concat([rows, pooled]).to_csv(out / "results.csv", index=False, float_format="%.6g")
    described.to_csv(out / "table6.csv", index=False, float_format="%.6g")
    parts = [("Table 6: the recordings", described.map(lambda value: cell(value, 1, 1)))]
    parts.append(("Figures, all drones of a sequence together", figures(pooled)))
    for title, column, factor in (
        ("Table 7: distance, lever arm taken out (mm)", "distance_m", 1e3),
        (
            "Table 7: distance to the reference's own point, lever arm and all (mm)",
            "distance_to_point_m",
            1e3,
        ),
        *((f"Table 8: difference in {name} (degrees)", f"{name}_deg", 1.0) for name in ANGLES),
        ("Angle between the orientations (degrees)", "angle_deg", 1.0),
    ):
        parts.append((title, statistics(pooled, column, factor)))
    if "offset_s_off_frames" in rows:
        parts.append(("Clocks: found minus planted, at most (frames)", clock_errors(rows)))
    text = "\n\n".join(f"## {title}\n\n{markdown(table)}" for title, table in parts)
    print(text)
    with atomic_write(out / "table7.md") as temporary:
        temporary.write_text(f"{text}\n")


def of_sequences(cases: list[Case]) -> list[Case]:
    """Pool all drones of a sequence."""
    together_by: dict[tuple, list[Measures]] = {}
    for key, measures in cases:
        together_by.setdefault((key["sequence"], "all", key["wrong"], key["method"]), []).append(measures)
    return [(dict(zip(KEYS, key, strict=True)), together(several)) for key, several in together_by.items()]


def figures(rows: pd.DataFrame) -> pd.DataFrame:
    """Table of errors against the true pose."""
    table = labels(rows)
    for column, (heading, factor, decimals) in FIGURES.items():
        table[heading] = [cell(value, factor, decimals) for value in rows[column]]
    return table


def statistics(rows: pd.DataFrame, column: str, factor: float) -> pd.DataFrame:
    """A table of the paper: mean, median, standard deviation, minimum and maximum."""
    table = labels(rows)
    for name in STATISTICS:
        table[name] = [cell(value, factor, 3 if factor == 1 else 2) for value in rows[f"{column}.{name}"]]
    table["frames"] = rows[f"{column}.count"].astype(str)
    return table


def clock_errors(rows: pd.DataFrame) -> pd.DataFrame:
    """Largest absolute clock error over the drones."""
    columns = {"offset_s_off_frames": "positions", "orientation_offset_s_off_frames": "orientations"}
    worst = (
        rows.assign(**rows[list(columns)].abs()).groupby(KEYS[:1] + KEYS[2:], sort=False)[list(columns)].max()
    )
    table = labels(worst.reset_index())
    for column, heading in columns.items():
        table[heading] = [cell(value, 1, 4) for value in worst[column]]
    return table


def labels(rows: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "sequence": list(rows["sequence"]),
            "wrong": [f"{wrong:.0%}" for wrong in rows["wrong"]],
            "method": list(rows["method"]),
        }
    )


def cell(value: object, factor: float, decimals: int) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if np.isnan(value) else f"{value * factor:.{decimals}f}"


def markdown(table: pd.DataFrame) -> str:
    lines = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


if __name__ == "__main__":
    main()
