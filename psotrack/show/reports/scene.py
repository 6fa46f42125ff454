"""HTML pages that need no network: the frame of a page, and the 3D view in a page or in a notebook's cell.

The 3D view shows drones, truth and cameras over time, as plain data for the JavaScript of `assets/scene.js`. Positions
are sent in float32, relative to an origin near the flight, so that a world in national coordinates, hundreds of
kilometres from its origin, loses nothing.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from psotrack import __version__
from psotrack.errors import OutputError
from psotrack.geometry import Rig
from psotrack.pipeline import TrackedRecording
from psotrack.recordings import Recording
from psotrack.show.flights import FlightTracks, TrackedFlight, ellipsoids_90, flight_of, rows_at, statuses
from psotrack.support import atomic_write, refuse_to_overwrite, short_repr
from psotrack.trajectories import Status, Trajectories

_Point = Float[np.ndarray, "3"]
_Rows = Float[np.ndarray, "rows"]
#: Largest size of a page, bytes: what e-mail and chat programs take as an attachment.
MOST_BYTES = 8_000_000
#: Height of a 3D view in a notebook, pixels.
_CELL_HEIGHT_PX = 520


def _asset(name: str) -> str:
    return (files("psotrack.show.reports") / "assets" / name).read_text(encoding="utf-8")


@cache
def _packed_library() -> str:
    """The library of the 3D view, compressed, as base64; the same bytes each time."""
    return base64.b64encode(gzip.compress(_asset("three.bundle.js").encode(), mtime=0)).decode("ascii")


def render(template: str, scene: dict[str, Any], **values: Any) -> str:
    """The text of a page.

    Args:
        template: name of a file in `assets`.
        scene: data of the 3D view; see `scene_data`.
        **values: what the template shows; text is escaped.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("psotrack.show.reports", "assets"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # `</script>` and the like in the data cannot end the script.
    data = json.dumps(scene, allow_nan=False).replace("<", "\\u003c").replace("&", "\\u0026")
    started = f"psotrackScene(document.getElementById('scene'), {data});"
    script = f"{_asset('scene.js')}\npsotrackStart({json.dumps(_packed_library())}, () => {{{started}}});"
    return environment.get_template(template).render(
        # The JavaScript and the base64 come from the package, and the data hold no "<".
        scripts=Markup(f"<script>{script}</script>"),
        page_css=Markup(_asset("page.css")),
        scene_css=Markup(_asset("scene.css")),
        page_js=Markup(_asset("page.js")),
        version=__version__,
        **values,
    )


def write_page(path: Path | str, text: str, *, force: bool = False) -> None:
    """Write a page.

    Raises:
        OutputError: the name does not end in .html, the page is larger than `MOST_BYTES`, the file exists and `force`
            is not set, or it cannot be written.
    """
    check_page_path(path, force)
    content = text.encode("utf-8")
    if len(content) > MOST_BYTES:
        raise OutputError(
            path,
            expected=f"a page of at most {MOST_BYTES / 1e6:.0f} MB",
            found=f"{len(content) / 1e6:.1f} MB",
            remedy="show fewer frames, or fewer files of tracks",
        )
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def check_page_path(path: Path | str, force: bool) -> None:
    """Raise `OutputError` unless a page may be written at `path`."""
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OutputError(path, expected="a file that ends in .html", found=path.name)
    refuse_to_overwrite(path, force)


#: Largest number of rows of a view. 5,000 rows of ten drones take 2 MB, and a slider has fewer pixels.
MOST_ROWS = 5000
#: Length of the drawn pyramids of the cameras, as a fraction of the extent of the scene.
_PYRAMID = 0.06
#: Coordinates beyond this distance from the world's origin lose millimetres in float32, metres.
_FAR_M = 1000.0


@dataclass(frozen=True, repr=False)
class View3D:
    """A flight that turns and plays; a notebook shows it, also after it was saved and opened again.

    Attributes:
        flight: the flight.
    """

    flight: TrackedFlight

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        content = render("scene.html", scene_data(self.flight), title="3D view")
        return (
            f'<iframe title="3D view" srcdoc="{html.escape(content)}" '
            f'style="width: 100%; height: {_CELL_HEIGHT_PX}px; border: 0"></iframe>'
        )


def view_3d(tracks: TrackedRecording | Trajectories, recording: Recording | None = None) -> View3D:
    """A view of tracks that turns and plays, for a notebook; a saved notebook keeps the view.

    Args:
        tracks: the result of `track`, or trajectories.
        recording: the recording, whose cameras and reference are shown; None shows the tracks alone.
    """
    return View3D(flight_of(tracks, recording))


def shown_times_s(flight: TrackedFlight) -> _Rows:
    """Times of the rows of a flight: of its first tracks, else of its reference, else of its recording."""
    first = flight.tracks[0].trajectories if flight.tracks else flight.truth
    if first is not None:
        return first.time_s
    assert flight.recording is not None
    return flight.recording.timeline().time_s


def row_step(num_rows: int) -> int:
    """Distance between the rows that are shown."""
    return -(-num_rows // MOST_ROWS)


def scene_data(flight: TrackedFlight) -> dict[str, Any]:
    """A flight as plain data, fit for JSON, with every n-th row where there are more than `MOST_ROWS`."""
    time_s = shown_times_s(flight)
    time_s = np.asarray(time_s, np.float64)[:: row_step(len(time_s))]
    low_m, high_m = _bounds_m(flight)
    origin_m = np.round((low_m + high_m) / 2) if np.abs([low_m, high_m]).max() > _FAR_M else np.zeros(3)
    truth = flight.truth
    true_m = [] if truth is None else np.swapaxes(_at_times(truth, time_s, truth.position_m) - origin_m, 0, 1)
    cameras = []
    if flight.recording is not None:
        cameras = _cameras(flight.recording.rig, origin_m, _PYRAMID * float((high_m - low_m).max()))
    return {
        "time_s": _packed(time_s),
        "origin_m": origin_m.tolist(),
        "bounds_m": [(low_m - origin_m).tolist(), (high_m - origin_m).tolist()],
        "drones": [drone for each in flight.tracks for drone in _drones(each, time_s, origin_m)],
        "truth": [_packed(own_m) for own_m in true_m],
        "cameras": cameras,
    }


def _bounds_m(flight: TrackedFlight) -> tuple[_Point, _Point]:
    """Lowest and highest coordinates of all that is shown, and of the floor, z = 0, if it is near."""
    low_m, high_m = flight.bounds_m or (np.zeros(3), np.zeros(3))
    middle_m = (low_m + high_m) / 2
    low_m, high_m = np.minimum(low_m, middle_m - 0.05), np.maximum(high_m, middle_m + 0.05)
    if 0 < low_m[2] < (high_m - low_m).max():
        low_m[2] = 0.0
    return low_m, high_m


def _drones(tracks: FlightTracks, time_s: _Rows, origin_m: _Point) -> list[dict[str, Any]]:
    flown = tracks.trajectories
    position_m = np.where(flown.seen[..., None], flown.position_m, np.nan)
    status = np.where(flown.seen, statuses(flown), Status.LOST)
    of_rows = {
        "position_m": _at_times(flown, time_s, position_m) - origin_m,
        "status": np.nan_to_num(_at_times(flown, time_s, status), nan=float(Status.LOST)),
    }
    if flown.covariance_m2 is not None:
        of_rows["half_axes_m"], turn = ellipsoids_90(_at_times(flown, time_s, flown.covariance_m2))
        turns = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_quat()
        of_rows["rotation_xyzw"] = turns.reshape(*turn.shape[:2], 4)
    return [
        {
            "name": name,
            "colour": tracks.colours[drone],
            "size_m": tracks.size_m[drone].tolist(),
            **{key: _packed(values[:, drone]) for key, values in of_rows.items()},
        }
        for drone, name in enumerate(tracks.names)
    ]


def _at_times(
    trajectories: Trajectories, time_s: _Rows, values: np.ndarray
) -> Float[np.ndarray, "rows *rest"]:
    """Values in the rows of a scene: those of the nearest frame, NaN where no frame is near."""
    rows = rows_at(trajectories, time_s)
    found = np.asarray(values, np.float64)[rows]
    found[rows < 0] = np.nan
    return found


def _cameras(rig: Rig, origin_m: _Point, length_m: float) -> list[dict[str, Any]]:
    """Centre of each camera, and the four corners of a pyramid that opens along its view, without distortion."""
    cameras = []
    for index, name in enumerate(rig.names):
        camera = rig.cameras[index]
        R, t_m = np.asarray(camera.T_cam_world)[:3, :3], np.asarray(camera.T_cam_world)[:3, 3]
        width, height = np.asarray(camera.image_size_wh, np.float64)
        corners_px = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]]) - [0.5, 0.5, 0]
        points_cam = length_m * corners_px @ np.linalg.inv(np.asarray(camera.K, np.float64)).T
        cameras.append(
            {
                "name": name,
                "centre_m": (np.asarray(camera.centre_world) - origin_m).tolist(),
                "corners_m": ((points_cam - t_m) @ R - origin_m).tolist(),
            }
        )
    return cameras


def _packed(values: np.ndarray) -> str:
    """Numbers as base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode("ascii")
