"""Bad input of the room: each is refused in one line that says what was expected and found, where, and the remedy."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from camera_paths import example_path, fly_twice_seen, make_paths_and_tracks, remove_poses, remove_positions
from helpers import assert_refused, calls, make_once, simple_lens
from marker_worlds import (
    DRAWN_LENS,
    PASSING_CAMERA,
    any_room,
    fly_past,
    found_markers,
    four_walls,
    long_table,
    make_drawn_flight,
    wide_table,
)

from psotrack.foreground.markers import MarkerDetector
from psotrack.geometry import make_rig
from psotrack.geometry.rig_files import write_calibration, write_rig
from psotrack.inside_out import (
    MarkerCentres,
    MarkerMap,
    PoseFilterParams,
    PoseSettings,
    build_map,
    check_map,
    fuse,
    open_source,
    read_camera_path,
    read_marker_map,
    read_measured_corners,
    smooth,
    write_camera_path,
)
from psotrack.inside_out.filtering import Agility, FilterRun, poses_of, step
from psotrack.inside_out.lens_files import choose_lens
from psotrack.inside_out.mapping import complete_map
from psotrack.inside_out.mapping.sightings import collect_sightings
from psotrack.inside_out.pose import CornerNoise, estimate_pose
from psotrack.recordings.mocap import Markers, write_c3d

ROOM = four_walls()


def localises(options, video="{flight}", lens="--fov 70,55.4"):
    return lambda folder, run: partial(
        run, f"localise {video} --markers {{corners}} {lens} --out {{new}} {options}"
    )


def maps(options):
    return lambda folder, run: partial(run, f"map {{flight}} {options}")


def fuses(options):
    return lambda folder, run: partial(run, f"fuse --out {{new}} {options}")


def reads(text):
    """A table of this text is read."""

    def prepare(folder, run):
        (folder / "corners.csv").write_bytes(text.encode())
        return partial(read_marker_map, folder / "corners.csv")

    return prepare


def reads_path(**values):
    """The table of a camera's path is read, whose first row has other values."""

    def prepare(folder, run):
        path = folder / "path.csv"
        write_camera_path(path, example_path(), "dron2")
        table = pd.read_csv(path, dtype=str)
        for column, value in values.items():
            table.loc[0, column] = value
        table.to_csv(path, index=False)
        return partial(read_camera_path, path)

    return prepare


def reads_lens(size_wh, **options):
    """A file of two lenses is read for images of a size."""

    def prepare(folder, run):
        write_rig(folder / "lens.toml", make_rig({"left": DRAWN_LENS, "right": DRAWN_LENS}))
        return partial(choose_lens, size_wh, path=folder / "lens.toml", fov_deg=None, **options)

    return prepare


def reads_lens_without_size(folder, run):
    """The dataset's CSV has no size of the images."""
    write_calibration(folder / "cameras.csv", make_rig({"cam1i": simple_lens(400.0, (640, 480))}))
    return partial(choose_lens, (1920, 1080), path=folder / "cameras.csv", fov_deg=None)


def reads_c3d(names, position_m):
    def prepare(folder, run):
        write_c3d(folder / "room.c3d", Markers(names, position_m, 100.0))
        return partial(read_measured_corners, folder / "room.c3d")

    return prepare


def third(corners):
    """The table of the room with other corners of marker 3, in line 4."""
    return wide_table({**ROOM, 3: corners})


def bent(distance_m, axis):
    """Marker 3 with one corner beside its place."""
    corners = ROOM[3].copy()
    corners[2, axis] += distance_m
    return corners


WIDE = wide_table(ROOM)
LONG = long_table(ROOM, ["id", "corner", "x_m", "y_m", "z_m"])
CELLS = WIDE.splitlines()[3].split(";")
MIRRORED = wide_table({marker: corners * [1.0, -1.0, 1.0] for marker, corners in ROOM.items()})
CORNERS_OF_3 = tuple(f"Marker3:{corner}" for corner in range(1, 5))
UNSEEN_M = np.ones((5, 4, 3))
UNSEEN_M[:, 1] = np.nan
NEGATIVE_STD = re.sub("(?m)$", ";-2", WIDE.rstrip()).replace("4[m];-2", "4[m];std[mm]")
THREE_ROWS = re.sub("\n3,3,.*", "", LONG)


def with_cells(cells):
    """The table with other cells of marker 3, in line 4."""
    lines = WIDE.splitlines()
    lines[3] = ";".join(cells)
    return reads("\n".join(lines))


def in_frames(*ids):
    """What two frames show."""
    found = found_markers(ids, np.zeros((len(ids), 4, 2)))
    return collect_sightings([(0, time_s, found) for time_s in (0.0, 0.2)], (DRAWN_LENS,))


PATHS, OUTSIDE, _ = fly_twice_seen(17, 30)
PATH = PATHS["dron1"]
STILL = replace(PATH, position_m=np.tile(PATH.position_m[0], (30, 1)))
UNSURE = replace(PATH, covariance=np.zeros((30, 6, 6)))
FAR = replace(OUTSIDE, position_m=OUTSIDE.position_m + 20)
STEPPED = partial(step, params=PoseFilterParams(), agility=Agility())
BEGUN = STEPPED(FilterRun(), 0.04, poses_of(PATH)[0])
CENTRES = MarkerCentres({name: corners.mean(axis=0) for name, corners in any_room().items()})
THREE = [found.select(np.isin(found.ids, [1, 2, 3])) for _, _, found in fly_past(3)[0]]
NOWHERE = np.full((4, 4, 2), np.nan), np.ones((4, 4, 3)), DRAWN_LENS

#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Tables of markers.
    "empty cell": (with_cells([*CELLS[:5], "", *CELLS[6:]]), "line 4, column y2[m]", "found nothing"),
    "three corners": (with_cells(CELLS[:10]), "line 4: expected 13 values, found 10; "),
    "three rows": (reads(THREE_ROWS), "line 10 to 12, marker 3", "found none of number 3; add"),
    "marker twice": (reads(WIDE.replace("\n4;", "\n3;")), "line 5, column id", "once, found 3 again"),
    "corner twice": (reads(LONG.replace("\n3,2,", "\n3,1,")), "line 11", "found corner 1 of marker 3 again"),
    "corner 4 from 0": (reads(LONG.replace("\n3,1,", "\n3,0,")), "line 5, column corner", "0 to 3, or tl"),
    "no number": (reads(WIDE.replace("\n3;", "\nthree;")), "line 4, column id", "found 'three'"),
    "decimal commas": (reads(WIDE.replace("3.0;", "3,0;")), "column y1[m]: ", "decimals with a point"),
    "another unit": (reads(WIDE.replace("x1[m]", "x1[in]")), "expected a column x1[m]", "found x1[in]"),
    "column twice": (reads(WIDE.replace("y2[m]", "x_2[m]")), "line 1", "found x2[m] and x_2[m]"),
    "no rows": (reads(WIDE.splitlines()[0]), "expected rows below the header, found none"),
    "nothing": (reads("\n"), "expected a table of marker corners, found an empty file"),
    "other numbers": (reads("1;2;3;4\n5;6;7;8\n"), "line 1: expected a header, or numbers in rows of 13"),
    "negative std": (reads(NEGATIVE_STD), "line 2, column std[mm]: expected a standard deviation of 0"),
    "not planar": (reads(third(bent(0.05, 1))), "line 4, marker 3", "a flat square", "25 mm off"),
    "not square": (reads(third(bent(0.06, 0))), "a flat square", "corners 4", "the side is 4"),
    "crossed": (reads(third(ROOM[3][[0, 1, 3, 2]])), "line 4, marker 3", "one after the other"),
    "same place": (reads(third(ROOM[2] + 0.01)), "line 4, marker 3", "both markers at the place of marker 2"),
    "one in mm": (reads(third(1e3 * ROOM[3])), "line 4, marker 3", "found 400 m; is it in mill", "x1[mm]"),
    "mirrored": (reads(MIRRORED), "16 of 16 markers face out of the room", "an axis is mirrored"),
    "not finite": (calls(MarkerMap, {5: np.full((4, 3), np.nan)}), "marker 5: expected finite corners"),
    "no markers": (calls(MarkerMap, {}), "at least one marker"),
    "unseen corner": (reads_c3d(CORNERS_OF_3, UNSEEN_M), "room.c3d, marker 3: ", "number 2 is never seen"),
    "labels of drones": (reads_c3d(("Dron1:Dron11",), np.ones((5, 1, 3))), "Marker7:1", "found Dron1"),
    # Maps from videos and from centres.
    "no frames": (calls(in_frames), "expected frames that show markers, found none in any frame"),
    "unseen known": (calls(build_map, in_frames(1, 2), {77: ROOM[7]}), "77 beside others, found only 1"),
    "known alone": (calls(build_map, in_frames(7), {7: ROOM[7]}), "in no frame; name another one by --known"),
    "no two of a map": (calls(check_map, in_frames(1, 2), MarkerMap({9: ROOM[1]})), "two markers of the map"),
    "three centres": (calls(complete_map, THREE, CENTRES, PASSING_CAMERA), "expected 4 markers", "found 3"),
    # Paths of cameras.
    "unknown flag": (reads_path(flags="few"), "line 2, column flags: ", "few_markers"),
    "unknown status": (reads_path(status="gone"), "line 2: expected one of ", "coasting", "in status"),
    "another drone": (reads_path(drone="dron3"), "path.csv: ", "one drone"),
    "length 3": (reads_path(qw="0", qx="3", qy="0", qz="0"), "line 2", "in qw, qx, qy, qz, found length 3"),
    "negative variance": (reads_path(cov_zz="-9e8"), "line 2: expected a covariance in cov_xx, "),
    "no covariance": (reads_path(cov_xa="1e9"), "line 2, column cov_xx: ", "in cov_xx to cov_cc"),
    "no time": (reads_path(time_s=""), "line 2: expected a time_s"),
    # Poses, their settings, and the filter.
    "no coordinates": (calls(estimate_pose, *NOWHERE, PoseSettings()), "finite coordinates"),
    "min_markers": (calls(PoseSettings, min_markers=0), "min_markers: expected at least 1, found 0"),
    "focal_error": (calls(PoseSettings, focal_error=-0.1), "a number from 0 to below 1, found -0.1"),
    "scale": (calls(CornerNoise, scale=0.0), "scale"),
    "longest_gap_s": (calls(PoseFilterParams, longest_gap_s=-1.0), "a number above 0, found -1"),
    "confirm": (calls(PoseFilterParams, confirm=0), "confirm: expected at least 1, found 0"),
    "earlier frame": (calls(STEPPED, BEGUN, 0.0, poses_of(PATH)[1]), "a time after 0.04 s, found 0 s"),
    "no error": (calls(smooth, UNSURE), "covariance at 0 s: expected a positive definite matrix"),
    # Fusion.
    "far tracks": (calls(fuse, PATHS, FAR), "outside tracks: expected a track within 0.5 m ", "nearest is 3"),
    "no pose": (calls(fuse, remove_poses(PATH, slice(30)), OUTSIDE), "inside paths: expected a pose in"),
    "no position": (calls(fuse, PATHS, remove_positions(OUTSIDE, slice(30))), "outside tracks: expected a"),
    "still": (calls(fuse, {"dron1": STILL}, OUTSIDE, max_offset_s=0.5), "the clock of dron1", "found none"),
    "fused into text": (fuses("{dron1} {tracks} --out {tmp}/a.txt"), "expected a file that ends in .csv"),
    "path twice": (fuses("{dron1} {dron1} {tracks}"), "a second path of dron1"),
    "tracks for a path": (fuses("{tracks} {tracks}"), "a camera's path with orientations"),
    "later": (fuses("{dron1} {later}"), "later.csv: ", "0.00 to 3.96 s of dron1, found 100.00 to 103.96 s; "),
    # Lenses, images, and detection.
    "another shape": (reads_lens((1920, 1080), name="left", scale=True), "640 x 480; ", "the shape differs"),
    "large images": (reads_lens((1280, 960), name="left"), "lens.toml", "for 1280 x 960", "--scale-camera"),
    "axis off": (reads_lens_without_size, "for 1920 x 1080", "an optical axis at (320, 240)"),
    "several lenses": (reads_lens((640, 480)), "one camera, found left, right; name it by --camera-name"),
    "no stream": (calls(open_source, "file:///nowhere.avi"), "a stream, found none that can be opened"),
    "no dictionary": (calls(MarkerDetector, "9x9"), "dictionary: expected one of ", "4x4_1000", "found 9x9"),
    "not in it": (calls(MarkerDetector, "4x4_50", ids=[50]), "markers of the map, found 4x4_50, 0 to 49"),
    # The command `onboard localise`.
    "no lens": (localises("", lens=""), "lens: expected --camera FILE or --fov H,V, found neither"),
    "sides of corners": (localises("--marker-size 0.3"), "a table of centres alone, found corners in"),
    "frames": (localises("--frames 99"), "frames: expected 1 to 14, the frames of ", "avi, found 99"),
    "drone": (localises("--drone dron1"), "--drone: expected a folder with videos of drones' own"),
    "number": (localises("", "0"), "0: expected a video, ", "pass --live if it is a camera's number"),
    "one output": (localises("--json {new}"), "--json: expected another file than --out"),
    "no rate": (localises("", "{images}"), "--fps: expected the rate at which ", "such as --fps 25"),
    "no images": (localises("", "{tmp}"), "images, which end in .png", "found neither; to use"),
    "readout nan": (localises("--readout nan"), "--readout: expected 0 to"),
    "long readout": (localises("--readout 0.05"), "between two frames at 25 frames per second, found 0.05"),
    # The command `onboard map`.
    "build and check": (maps("--out {new} --check {corners}"), "--check MAP, found both"),
    "no known": (maps("--out {new}"), "expected numbers of markers that are known"),
    "no place": (maps("--out {new} --known 17"), "--markers with the corners of the known"),
    "not in table": (maps("--out {new} --known 9 --markers {corners}"), "expected the known marker 9"),
    "video as map": (maps("--check {flight}"), "flight.avi: expected UTF-8 text"),
}


@pytest.mark.parametrize(("prepare", "words"), [(one, words) for one, *words in BAD.values()], ids=BAD)
def test_bad_input_is_refused_in_one_line(prepare, words, tmp_path_factory, run_psotrack, tmp_path):
    drawn = make_once(tmp_path_factory, "drawn_flight", make_drawn_flight)
    flown = make_once(tmp_path_factory, "paths_and_tracks", make_paths_and_tracks)
    paths = {path.stem: path for path in (*drawn.iterdir(), *flown.iterdir())}
    paths |= {"tmp": tmp_path, "new": tmp_path / "new.csv"}

    def run(line):
        return run_psotrack("onboard", *(word.format(**paths) for word in line.split()))

    assert_refused(prepare(tmp_path, run), *words, unchanged=tmp_path)
