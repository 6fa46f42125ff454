"""`psotrack onboard detect`: ArUco markers and AprilTags in photographs and videos."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from psotrack.cli.commands import command
from psotrack.cli.options import Dictionary, NumFrames
from psotrack.cli.output import Output, check_suffix
from psotrack.errors import InputError, SettingsError

if TYPE_CHECKING:
    from psotrack.foreground.markers import DetectedMarkers


@command("detect")
def detect_markers(
    output: Output,
    images: tuple[Path, ...],
    *,
    out: Path = Path("markers.csv"),
    dictionary: Dictionary = "4x4_50",
    num_frames: NumFrames = None,
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
      psotrack onboard detect photo.jpg --dictionary 4x4_50 --out markers.csv
      psotrack onboard detect photos --dictionary apriltag_36h11 --out markers.csv
      psotrack onboard detect a.jpg b.png c.tif --dictionary 6x6_250 --out markers.csv --json -
      psotrack onboard detect flight.mp4 --dictionary 4x4_1000 --out markers.csv --frames 100

    Options:
        out: CSV file of the markers.
    """
    from psotrack.foreground.markers import marker_dictionary
    from psotrack.inside_out import markers_of_images, markers_of_video, open_source, write_marker_table

    check_suffix("--out", out, ".csv")
    output.refuse(out)
    marker_dictionary(dictionary)
    photographs = _photographs(images)
    found: list[DetectedMarkers]
    if photographs is None:
        names, what = None, "frames"
        found = list(markers_of_video(open_source(images[0]).first(num_frames), dictionary, output.report))
    else:
        if num_frames is not None:
            raise SettingsError("--frames", expected="a video", found="images")
        names, what = _names(photographs), "images"
        found = list(markers_of_images(photographs, dictionary, output.report))
    write_marker_table(out, found, names, force=output.force)
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
    output.json(content)
    doubt = "" if counts else "; check that --dictionary names the printed markers"
    sentence = f"{out}: {counts.total()} markers in {showing} of {len(found)} {what}{doubt}"
    output.say(sentence)


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
