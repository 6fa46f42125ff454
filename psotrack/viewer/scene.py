"""The entities of a flight in Rerun: where each of them is in the tree, and which values it has at which times.

    world/cameras/CAMERA        pose and lens; below it image, silhouettes, boxes, ellipses, blobs, detections
    world/drones/DRONE          body, ellipsoid, trail and path; of several files world/drones/FILE/DRONE
    world/truth/DRONE           the reference
    world/onboard/DRONE         the camera on a drone; below it image and markers
    plots/QUANTITY/DRONE        values over time
    status/DRONE                tracked, coasting or lost
    events/KIND                 sentences

Rerun has no lens distortion: marks are drawn in the pixels of the raw images, and frusta are those of K.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8

from psotrack.errors import InputError
from psotrack.evaluation import errors_over_time
from psotrack.flights import (
    EventKind,
    Flight,
    FlightTracks,
    boxes_in_images,
    ellipses_in_images,
    ellipsoids_90,
    find_events,
    shown_frames,
)
from psotrack.geometry.rotations import rotation_matrices
from psotrack.recordings import Detections, Timeline, read_detections
from psotrack.support import COLOURS
from psotrack.trajectories import Status, Trajectories
from psotrack.viewer.camera_images import CameraImages, CameraKey, split_images

#: Timelines: seconds of the recording, and numbers of instants.
TIME, FRAME = "time", "frame"
#: Rows that are sent together: Rerun keeps what is sent together in one piece.
_ROWS = 2000
_ROWS_OF_IMAGES = 25
#: How much white is mixed into the colours, because the viewer is dark, and into those of predicted drones.
_LIGHTER, _COASTING_LIGHTER = 0.25, 0.7
_LOST_RGBA = (150, 150, 150, 160)
_TRUTH_RGBA = (255, 255, 255, 130)
_DETECTION_RGBA = (255, 214, 10, 255)
_BLOB_RGBA = (120, 255, 190, 160)
_MARKER_RGBA = (255, 90, 200, 255)
_WARNINGS = {EventKind.LOST, EventKind.SWITCH, EventKind.LEFT_OUT}
#: Distance of the images from the cameras in the 3D view, metres.
IMAGE_DISTANCE_M = 1.0
#: Points of the outline of an ellipse.
_OUTLINE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 25)), np.sin(np.linspace(0, 2 * np.pi, 25))], axis=-1)

#: A quantity that is plotted over time: its values, (frames, drones), and its name.
_Columns = Callable[[slice], Any]


class FlightScene:
    """Logs a flight into a recording of Rerun.

    Args:
        stream: the recording of Rerun.
        flight: the flight.
    """

    def __init__(self, stream: rr.RecordingStream, flight: Flight) -> None:
        self._stream, self._flight = stream, flight
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)

    def log_world(self) -> None:
        """Log what does not move: cameras, bounds and markers."""
        self._static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        recording = self._flight.recording
        if recording is None:
            return
        for index, name in enumerate(recording.rig.names):
            camera = recording.rig.cameras[index]
            T_world_cam = np.linalg.inv(np.asarray(camera.T_cam_world, np.float64))
            path = camera_path(name)
            self._static(path, rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3]))
            self._static(path, _pinhole(np.asarray(camera.K), np.asarray(camera.image_size_wh)))
        if recording.bounds_m is not None:
            low, high = np.array(recording.bounds_m).reshape(3, 2).T
            self._static(
                "world/bounds",
                rr.Boxes3D(centers=[(low + high) / 2], half_sizes=[(high - low) / 2], colors=[(90, 90, 90)]),
            )
        if recording.marker_corners is not None:
            self._log_marker_map()

    def _log_marker_map(self) -> None:
        from psotrack.inside_out import MarkerMap, read_marker_table

        assert self._flight.recording is not None
        assert self._flight.recording.marker_corners is not None
        table = read_marker_table(self._flight.recording.marker_corners)
        if isinstance(table, MarkerMap):
            corners_m = table.all_corners_m[:, [0, 1, 2, 3, 0]]
            self._static("world/markers", rr.LineStrips3D(corners_m, colors=[_MARKER_RGBA], radii=[0.004]))

    def log_tracks(self) -> None:
        """Log drones, reference, plots and events."""
        for number, tracks in enumerate(self._flight.tracks):
            colours = [rgb(colour) for colour in self._flight.colours(number)]
            for drone in range(tracks.trajectories.num_drones):
                self._log_drone(tracks, drone, colours[drone])
            self._log_plots(tracks, colours)
        truth = self._flight.truth
        if truth is not None:
            for drone, name in enumerate(truth.drones):
                self._log_truth(truth, drone, name)
        for event in find_events(self._flight) if self._flight.tracks else ():
            text = event.text if len(self._flight.tracks) == 1 else f"{event.tracks}: {event.text}"
            self._rows(
                f"events/{event.kind.replace(' ', '_')}",
                [event.frame],
                [event.time_s],
                lambda _, text=text, kind=event.kind: rr.TextLog.columns(
                    text=[text], level=["WARN" if kind in _WARNINGS else "INFO"]
                ),
            )

    def log_marks(self, step: int) -> None:
        """Log boxes, ellipses and detections in the images.

        Args:
            step: each frame whose number is a multiple of it is shown.
        """
        recording = self._flight.recording
        if recording is None:
            return
        for number, tracks in enumerate(self._flight.tracks):
            self._log_boxes(tracks, [rgb(colour) for colour in self._flight.colours(number)], step)
        timeline = self._timeline()
        for index, name in enumerate(recording.rig.names):
            if recording.detections is not None and name in recording.detections:
                detections = read_detections(recording.detections[name])
                self._log_detections(timeline, index, name, detections, step)

    def log_images(self, camera: CameraKey, images: CameraImages, reduction: int, cell_px: int) -> None:
        """Log the images of a camera: of the rig with silhouettes and blobs, on a drone with path and markers.

        Args:
            camera: the camera.
            images: its images.
            reduction: image pixels per shown pixel, along each side.
            cell_px: image pixels per pixel of the silhouettes, along each side.
        """
        path = key_path(camera)
        self._static(f"{path}/image", rr.Transform3D(scale=[reduction, reduction, 1]))
        if camera.on_drone:
            self._log_onboard(path, camera.name, images)
            return
        timeline = self._timeline()
        rows, chosen = _rows_of_images(timeline.frame[:, timeline.cameras.index(camera.name)], images)
        at = (rows, timeline.time_s[rows])
        has_silhouettes = bool(images.blobs_px)
        if has_silhouettes:
            self._static(f"{path}/silhouettes", rr.Transform3D(scale=[cell_px, cell_px, 1]))
        self._log_encoded(path, images, chosen, *at)
        if has_silhouettes:
            blobs_px = [images.blobs_px[index] for index in chosen]
            self._boxes(f"{path}/blobs", *at, blobs_px, _BLOB_RGBA, 0.75)

    def _log_onboard(self, path: str, name: str, images: CameraImages) -> None:
        assert self._flight.recording is not None
        assert self._flight.recording.onboard is not None
        video = self._flight.recording.onboard[name]
        num_frames = min(len(video.position_m), video.video.num_frames)
        position_m, orientation_wxyz = video.position_m[:num_frames], video.orientation_wxyz[:num_frames]
        known = np.flatnonzero(
            np.isfinite(position_m).all(axis=1) & np.isfinite(orientation_wxyz).all(axis=1)
        )
        rotation = rotation_matrices(orientation_wxyz[known])
        self._rows(
            path,
            known,
            known / video.video.fps,
            lambda rows: rr.Transform3D.columns(
                translation=position_m[known][rows],
                # Rerun has matrices column by column.
                mat3x3=np.swapaxes(rotation[rows], 1, 2).reshape(-1, 9),
            ),
        )
        if video.K is not None:
            self._static(path, _pinhole(video.K, np.array(video.video.image_size_wh), distance_m=0.4))
        at = (images.frame, images.frame / video.video.fps)
        self._log_encoded(path, images, np.arange(len(images.frame)), *at)
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        outlines = [corners_px[:, [0, 1, 2, 3, 0]] + 0.5 for _, corners_px in images.markers]
        counts = np.array([len(each) for each in outlines], int)
        self._strips_2d(
            f"{path}/markers",
            *at,
            [line for each in outlines for line in each],
            counts,
            np.tile(np.array(_MARKER_RGBA, np.uint8), (counts.sum(), 1)),
            [f"{marker}" for ids, _ in images.markers for marker in ids],
        )

    def _timeline(self) -> Timeline:
        """The instants at which images are shown: those of the recording."""
        assert self._flight.recording is not None
        return self._flight.recording.timeline()

    # Drones

    def _log_drone(self, tracks: FlightTracks, drone: int, colour: tuple[int, int, int]) -> None:
        trajectories = tracks.trajectories
        path = self._drone_path("world/drones", tracks, trajectories.drones[drone])
        known = np.flatnonzero(np.isfinite(trajectories.position_m[:, drone]).all(axis=-1))
        position_m = trajectories.position_m[known, drone]
        status = statuses(trajectories)[known, drone]
        rgba = colours_of(status, colour)
        label = self._drone_label(tracks, trajectories.drones[drone])
        labels = [label if state == Status.TRACKED else f"{label} {Status(state).label}" for state in status]
        half_m = np.broadcast_to(tracks.size_m[drone] / 2, position_m.shape)
        at = (trajectories.frame[known], trajectories.time_s[known])
        self._rows(
            f"{path}/body",
            *at,
            lambda rows: rr.Boxes3D.columns(
                centers=position_m[rows], half_sizes=half_m[rows], colors=rgba[rows], labels=labels[rows]
            ),
        )
        # From the row before to this one; nothing over a gap.
        follows = np.diff(known, prepend=-2) == 1
        before_m = np.where(follows[:, None], np.roll(position_m, 1, axis=0), position_m)
        segments = np.stack([before_m, position_m], axis=1)
        self._rows(
            f"{path}/trail",
            *at,
            lambda rows: rr.LineStrips3D.columns(strips=segments[rows], colors=rgba[rows]),
        )
        if trajectories.covariance_m2 is not None:
            ellipsoids = ellipsoids_90(trajectories.covariance_m2[known, drone])
            there = np.isfinite(ellipsoids.half_axes_m).all(axis=-1)
            axes_m, xyzw = ellipsoids.half_axes_m[there], quaternions_xyzw(ellipsoids.rotation[there])
            self._rows(
                f"{path}/ellipsoid",
                at[0][there],
                at[1][there],
                lambda rows: rr.Ellipsoids3D.columns(
                    centers=position_m[there][rows],
                    half_sizes=axes_m[rows],
                    quaternions=xyzw[rows],
                    colors=rgba[there][rows],
                ),
            )
            self._static(f"{path}/ellipsoid", rr.Ellipsoids3D.from_fields(fill_mode="solid"))
        strips = _strips(trajectories, drone)
        self._static(
            f"{path}/path",
            rr.LineStrips3D(
                [strip_m for strip_m, _ in strips],
                colors=[(*colours_of(np.array([state]), colour)[0, :3], 110) for _, state in strips],
                radii=[0.006],
            ),
        )

    def _log_truth(self, truth: Trajectories, drone: int, name: str) -> None:
        known = np.flatnonzero(np.isfinite(truth.position_m[:, drone]).all(axis=-1))
        position_m = truth.position_m[known, drone]
        path = f"world/truth/{part(name)}"
        self._static(f"{path}/point", rr.Points3D.from_fields(colors=[_TRUTH_RGBA], radii=[0.03]))
        self._rows(
            f"{path}/point",
            truth.frame[known],
            truth.time_s[known],
            lambda rows: rr.Points3D.columns(positions=position_m[rows]),
        )
        self._static(f"{path}/path", rr.LineStrips3D([position_m], colors=[_TRUTH_RGBA], radii=[0.004]))

    # Plots

    def _log_plots(self, tracks: FlightTracks, colours: Sequence[tuple[int, int, int]]) -> None:
        trajectories = tracks.trajectories
        at = (trajectories.frame, trajectories.time_s)
        seen = trajectories.seen
        quantities: dict[str, Float[np.ndarray, "frames drones"] | None] = {
            "score": trajectories.fitness,
            "cameras": trajectories.num_cameras,
        }
        if trajectories.covariance_m2 is not None:
            variance_m2 = np.trace(trajectories.covariance_m2, axis1=-2, axis2=-1)
            quantities["deviation_mm"] = 1e3 * np.sqrt(np.maximum(variance_m2, 0.0))
        for quantity, values in quantities.items():
            if values is None:
                continue
            for drone, name in enumerate(trajectories.drones):
                shown = np.where(seen[:, drone], values[:, drone], np.nan).astype(np.float64)
                path = self._drone_path(f"plots/{quantity}", tracks, name)
                self._series(path, *at, shown, colours[drone], self._drone_label(tracks, name))
        for drone, name in enumerate(trajectories.drones):
            self._log_status(tracks, drone, name)
        if self._flight.truth is not None:
            self._log_errors(tracks, colours)

    def _log_errors(self, tracks: FlightTracks, colours: Sequence[tuple[int, int, int]]) -> None:
        assert self._flight.truth is not None
        try:
            errors = errors_over_time(tracks.trajectories, self._flight.truth)
        except InputError:
            # The reference knows no position at the time of the tracks.
            return
        for number, (name, of_drone) in enumerate(errors.groupby("drone", observed=True)):
            colour = colours[0] if len(self._flight.tracks) > 1 else rgb(COLOURS[number % len(COLOURS)])
            self._series(
                self._drone_path("plots/error_mm", tracks, f"{name}"),
                of_drone["frame"].to_numpy(np.int64),
                of_drone["time_s"].to_numpy(np.float64),
                1e3 * of_drone["error_m"].to_numpy(np.float64),
                colour,
                self._drone_label(tracks, f"{name}"),
            )

    def _log_status(self, tracks: FlightTracks, drone: int, name: str) -> None:
        trajectories = tracks.trajectories
        path = self._drone_path("status", tracks, name)
        status = statuses(trajectories)[:, drone]
        changes = np.flatnonzero(np.diff(status, prepend=-1))
        self._static(
            path,
            rr.StateConfiguration(
                values=[each.label for each in Status],
                labels=[each.label for each in Status],
                colors=[(60, 160, 90), (230, 170, 40), (200, 60, 60)],
            ),
        )
        self._rows(
            path,
            trajectories.frame[changes],
            trajectories.time_s[changes],
            lambda rows: rr.StateChange.columns(
                state=[Status(state).label for state in status[changes][rows]]
            ),
        )

    def _series(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        values: Float[np.ndarray, " rows"],
        colour: tuple[int, int, int],
        name: str,
    ) -> None:
        self._static(path, rr.SeriesLines(colors=[colour], names=[name], widths=[1.5]))
        self._rows(path, frame, time_s, lambda rows: rr.Scalars.columns(scalars=values[rows]))

    # Images

    def _log_encoded(
        self,
        path: str,
        images: CameraImages,
        chosen: Int[np.ndarray, " rows"],
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
    ) -> None:
        has_silhouettes = bool(images.blobs_px)
        for first in range(0, len(chosen), _ROWS_OF_IMAGES):
            piece = slice(first, first + _ROWS_OF_IMAGES)
            pairs = split_images(images, chosen[piece].tolist())
            of_kind = {"image": ([jpeg for jpeg, _ in pairs], "image/jpeg", 0.0)}
            if has_silhouettes:
                of_kind["silhouettes"] = ([png for _, png in pairs], "image/png", 1.0)
            for kind, (blobs, media_type, order) in of_kind.items():
                self._rows(
                    f"{path}/{kind}",
                    frame[piece],
                    time_s[piece],
                    lambda _, blobs=blobs, media_type=media_type, order=order: rr.EncodedImage.columns(
                        blob=blobs,
                        media_type=[media_type] * len(blobs),
                        draw_order=np.full(len(blobs), order),
                    ),
                )

    def _log_boxes(self, tracks: FlightTracks, colours: Sequence[tuple[int, int, int]], step: int) -> None:
        recording, trajectories = self._flight.recording, tracks.trajectories
        assert recording is not None
        shown = shown_frames(recording, trajectories)
        boxes_px = boxes_in_images(recording, trajectories, tracks.size_m)
        ellipses = ellipses_in_images(recording, trajectories)
        status = statuses(trajectories)
        names = [self._drone_label(tracks, name) for name in trajectories.drones]
        for index, camera in enumerate(recording.rig.names):
            rows = _rows_shown(shown.frame[:, index], step)
            at = (trajectories.frame[rows], trajectories.time_s[rows])
            there = np.isfinite(boxes_px[rows, :, index]).all(axis=-1)
            _, drone = np.nonzero(there)
            rgba = np.zeros((*there.shape, 4), np.uint8)
            for each, colour in enumerate(colours):
                rgba[:, each] = colours_of(status[rows, each], colour)
            path = self._file_path(f"{camera_path(camera)}/boxes", tracks)
            self._boxes(
                path,
                *at,
                [boxes_px[row, there[number], index] for number, row in enumerate(rows)],
                rgba[there],
                1.5,
                [names[each] for each in drone],
            )
            if ellipses is None:
                continue
            drawn = np.isfinite(ellipses.middle_px[rows, :, index]).all(axis=-1)
            middle_px, shape_px2 = ellipses.middle_px[rows, :, index], ellipses.shape_px2[rows, :, index]
            # Pixel centres are at whole numbers, in Rerun half a pixel further.
            outlines_px = outline_px(middle_px[drawn] + 0.5, shape_px2[drawn])
            self._strips_2d(
                self._file_path(f"{camera_path(camera)}/ellipses", tracks),
                *at,
                list(outlines_px),
                drawn.sum(axis=1),
                rgba[drawn],
            )

    def _log_detections(
        self, timeline: Timeline, index: int, name: str, detections: Detections, step: int
    ) -> None:
        rows = _rows_shown(timeline.frame[:, index], step)
        of_rows = [detections.in_frame(int(frame)).xyxy for frame in timeline.frame[rows, index]]
        self._boxes(
            f"{camera_path(name)}/detections", rows, timeline.time_s[rows], of_rows, _DETECTION_RGBA, 0.75
        )

    def _boxes(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        boxes_px: Sequence[Float[np.ndarray, "boxes 4"]],
        rgba: tuple[int, int, int, int] | UInt8[np.ndarray, "boxes 4"],
        radius: float,
        labels: Sequence[str] | None = None,
    ) -> None:
        """Log the boxes of each row: none where a row has none, so that the boxes before go away."""
        if not len(frame):
            return
        counts = np.array([len(each) for each in boxes_px], int)
        xyxy = np.concatenate([np.zeros((0, 4)), *boxes_px])
        colours = np.broadcast_to(np.array(rgba, np.uint8), (len(xyxy), 4))
        ends = np.cumsum(counts)

        def columns(rows: slice) -> Any:
            boxes = slice(ends[rows][0] - counts[rows][0], ends[rows][-1])
            found = rr.Boxes2D.columns(
                half_sizes=(xyxy[boxes, 2:] - xyxy[boxes, :2]) / 2,
                centers=(xyxy[boxes, 2:] + xyxy[boxes, :2]) / 2,
                colors=colours[boxes],
                labels=None if labels is None else list(labels[boxes]),
            )
            return found.partition(counts[rows])

        self._static(path, rr.Boxes2D.from_fields(radii=[-radius], show_labels=labels is not None))
        self._rows(path, frame, time_s, columns)

    def _strips_2d(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        strips_px: Sequence[Float[np.ndarray, "points 2"]],
        counts: Int[np.ndarray, " rows"],
        rgba: UInt8[np.ndarray, "strips 4"],
        labels: Sequence[str] | None = None,
    ) -> None:
        """Log the lines of each row; `counts` says how many each row has."""
        if not len(frame):
            return
        ends = np.cumsum(counts)

        def columns(rows: slice) -> Any:
            lines = slice(ends[rows][0] - counts[rows][0], ends[rows][-1])
            found = rr.LineStrips2D.columns(
                strips=strips_px[lines],
                colors=rgba[lines],
                labels=None if labels is None else list(labels[lines]),
            )
            return found.partition(counts[rows])

        self._static(path, rr.LineStrips2D.from_fields(radii=[-1.0], show_labels=labels is not None))
        self._rows(path, frame, time_s, columns)

    # Paths and rows

    def _drone_label(self, tracks: FlightTracks, name: str) -> str:
        return name if len(self._flight.tracks) == 1 else f"{tracks.label} {name}"

    def _drone_path(self, root: str, tracks: FlightTracks, name: str) -> str:
        return f"{self._file_path(root, tracks)}/{part(name)}"

    def _file_path(self, root: str, tracks: FlightTracks) -> str:
        return root if len(self._flight.tracks) == 1 else f"{root}/{part(tracks.label)}"

    def _static(self, path: str, values: Any) -> None:
        self._stream.log(path, values, static=True, strict=True)

    def _rows(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"] | list[int],
        time_s: Float[np.ndarray, " rows"] | list[float],
        columns: _Columns,
    ) -> None:
        """Send rows in pieces; `columns` makes the columns of some rows."""
        frames, times_s = np.asarray(frame, np.int64), np.asarray(time_s, np.float64)
        for first in range(0, len(frames), _ROWS):
            rows = slice(first, first + _ROWS)
            rr.send_columns(
                path,
                [
                    rr.TimeColumn(TIME, duration=times_s[rows]),
                    rr.TimeColumn(FRAME, sequence=frames[rows]),
                ],
                columns(rows),
                recording=self._stream,
                strict=True,
            )


def part(name: str) -> str:
    """A name as one part of an entity path."""
    return rr.escape_entity_path_part(name)


def camera_path(name: str) -> str:
    """Path of a camera's entity."""
    return f"world/cameras/{part(name)}"


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour #rrggbb, lighter, because the viewer is dark."""
    red, green, blue = (
        round(int(colour[place : place + 2], 16) * (1 - _LIGHTER) + 255 * _LIGHTER) for place in (1, 3, 5)
    )
    return red, green, blue


def colours_of(status: Int[np.ndarray, " rows"], colour: tuple[int, int, int]) -> UInt8[np.ndarray, "rows 4"]:
    """Colours by status: the drone's own where it is tracked, paler where it is predicted, grey where it is lost."""
    own = np.array(colour, float)
    paler = own + (255 - own) * _COASTING_LIGHTER
    table = np.array([[*own, 255], [*paler, 255], _LOST_RGBA]).round().astype(np.uint8)
    return table[status]


def statuses(trajectories: Trajectories) -> Int[np.ndarray, "frames drones"]:
    """Status of each drone in each frame; of tracks without status, lost where there is no position."""
    if trajectories.status is not None:
        return trajectories.status
    return np.where(trajectories.seen, int(Status.TRACKED), int(Status.LOST))


def outline_px(
    middle_px: Float[np.ndarray, "ellipses 2"], shape_px2: Float[np.ndarray, "ellipses 2 2"]
) -> Float[np.ndarray, "ellipses points 2"]:
    """Points on ellipses (x - middle)ᵀ S⁻¹ (x - middle) = 1."""
    square, directions = np.linalg.eigh(shape_px2)
    half_px = np.sqrt(np.maximum(square, 0.0))
    return middle_px[:, None] + np.einsum("eij,ej,pj->epi", directions, half_px, _OUTLINE)


def quaternions_xyzw(rotation: Float[np.ndarray, "rows 3 3"]) -> Float[np.ndarray, "rows 4"]:
    """Unit quaternions in the order of Rerun."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat() if len(rotation) else np.zeros((0, 4))


def key_path(camera: CameraKey) -> str:
    """Path of the entity of a camera of the rig or on a drone."""
    return f"world/onboard/{part(camera.name)}" if camera.on_drone else camera_path(camera.name)


def _pinhole(
    K: Float[np.ndarray, "3 3"], image_size_wh: np.ndarray, distance_m: float = IMAGE_DISTANCE_M
) -> rr.Pinhole:
    shifted = np.array(K, np.float64)
    # Pixel centres are at whole numbers in K, and half a pixel further in Rerun.
    shifted[:2, 2] += 0.5
    width, height = (int(side) for side in image_size_wh)
    return rr.Pinhole(
        image_from_camera=shifted,
        width=width,
        height=height,
        image_plane_distance=distance_m,
        color=(110, 110, 110),
    )


def _strips(trajectories: Trajectories, drone: int) -> list[tuple[Float[np.ndarray, "points 3"], int]]:
    """The whole path of a drone in pieces of one status, each with the first point of the next piece."""
    status = statuses(trajectories)[:, drone].astype(int)
    known = np.isfinite(trajectories.position_m[:, drone]).all(axis=-1)
    status = np.where(known, status, -1)
    borders = np.flatnonzero(np.diff(status, prepend=-2, append=-2))
    found = []
    for start, stop in zip(borders, borders[1:], strict=False):
        if status[start] in (Status.TRACKED, Status.COASTING):
            end = stop + 1 if stop < len(status) and known[stop] and status[stop] != Status.LOST else stop
            found.append((trajectories.position_m[start:end, drone], int(status[start])))
    return found


def _rows_shown(frame: Int[np.ndarray, " instants"], step: int) -> Int[np.ndarray, " rows"]:
    """Instants at which a camera shows a new frame whose number is a multiple of `step`."""
    is_new = np.diff(frame, prepend=-1) != 0
    return np.flatnonzero((frame >= 0) & (frame % step == 0) & is_new)


def _rows_of_images(
    frame: Int[np.ndarray, " instants"], images: CameraImages
) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " rows"]]:
    """Instants at which a camera shows one of its images for the first time, and the indices of the images."""
    is_new = np.diff(frame, prepend=-1) != 0
    rows = np.flatnonzero(is_new & np.isin(frame, images.frame))
    return rows, np.searchsorted(images.frame, frame[rows])
