"""`psotrack detect-markers`: ArUco markers and AprilTags in photographs and videos."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psotrack.cli.options import (
    FORCE,
    JSON,
    dictionary_option,
    frames_option,
    reporting,
)
from psotrack.cli.output import check_outputs, output_json, print_line, report_to
from psotrack.errors import InputError, SettingsError

if TYPE_CHECKING:
    from psotrack.inside_out.detection import DetectedMarkers


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="CSV file of the markers.")
@dictionary_option("4x4_50")
@frames_option
@FORCE
@reporting
@JSON
def detect_markers(
    images: tuple[Path, ...],
    out: Path,
    dictionary: str,
    num_frames: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Find the ArUco markers and AprilTags in IMAGES, and their corners.

    IMAGES are photographs, which may differ in size, folders of photographs, or one video. Writes one row per marker:
    the image (or, of a video, the frame, from 0), the id, the four corners from the marker's own top left clockwise, in
    pixels (the middle of the first pixel is 0,0), and the standard deviation of a corner along x and along y. Prints
    may be inverted, and several markers of an image may have the same id.

    Photographs are searched thoroughly, which takes seconds for tens of megapixels; the frames of a video are searched
    with a part of the effort.

    \b
    Examples:
      psotrack detect-markers photo.jpg --dictionary 4x4_50 --out markers.csv
      psotrack detect-markers photos --dictionary apriltag_36h11 --out markers.csv
      psotrack detect-markers a.jpg b.png c.tif --dictionary 6x6_250 --out markers.csv --json -
      psotrack detect-markers flight.mp4 --dictionary 4x4_1000 --out markers.csv --frames 100
    """
    from psotrack.foreground.detection import marker_dictionary
    from psotrack.inside_out import markers_of_images, markers_of_video, open_source, write_marker_table

    check_outputs(out, json_path, force)
    marker_dictionary(dictionary)
    photographs = _photographs(images)
    found: list[DetectedMarkers]
    if photographs is None:
        names, what = None, "frames"
        found = list(markers_of_video(open_source(images[0]).first(num_frames), dictionary, report_to(quiet)))
    else:
        if num_frames is not None:
            raise SettingsError("--frames", expected="a video", found="images")
        names, what = _names(photographs), "images"
        found = list(markers_of_images(photographs, dictionary, report_to(quiet)))
    write_marker_table(out, found, names, force=force)
    counts = Counter(marker for markers in found for marker in markers.ids.tolist())
    showing = sum(len(markers) > 0 for markers in found)
    content = {
        "out": str(out),
        "dictionary": dictionary,
        what: len(found),
        f"{what}_with_markers": showing,
        "markers": counts.total(),
        "by_id": {f"{marker}": count for marker, count in sorted(counts.items())},
    }
    output_json(json_path, content, force)
    doubt = "" if counts else "; check that --dictionary names the printed markers"
    sentence = f"{out}: {counts.total()} markers in {showing} of {len(found)} {what}{doubt}"
    print_line(quiet, json_path, sentence)


def _photographs(images: tuple[Path, ...]) -> list[Path] | None:
    """Files of photographs, folders replaced by the images in them; None for a video."""
    from psotrack.recordings import IMAGE_SUFFIXES, image_files, is_image

    paths: list[Path] = []
    for path in images:
        if path.is_dir():
            inside = image_files(path)
            if not inside:
                expected = f"images, which end in {', '.join(IMAGE_SUFFIXES)}"
                raise InputError(path, expected=expected, found="none in this folder")
            paths += inside
        elif is_image(path) or not path.exists():
            paths.append(path)
        elif len(images) == 1:
            return None
        else:
            raise InputError(
                path,
                expected="an image or a folder of images",
                found="another file",
                remedy="a video needs a call of its own",
            )
    return paths


def _names(paths: list[Path]) -> list[str]:
    """Names of images in the table: file names; paths, if two files have the same name."""
    names = [path.name for path in paths]
    return names if len(set(names)) == len(names) else list(map(str, paths))
