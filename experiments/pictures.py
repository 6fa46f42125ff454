"""Make the pictures of the viewer, of an overlay video and of a report, which README and how-to pages show.

python experiments/pictures.py      # needs Chromium and the package playwright
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from psotrack.recordings import probe, read_frames
from psotrack.show.viewer import viewer_program

SCENARIO = "S02_D4_A"
FRAMES = 125
WINDOW_WH = (1600, 900)
#: Place of the shown moment: fraction of the flight, and the slider's ends and height in the window, pixels.
MOMENT, SLIDER_X_PX, SLIDER_Y_PX = 0.62, (267, 1393), 886
#: Windows of the report: width and height in pixels, and colour scheme.
REPORTS = {"report": (1280, 860, "light"), "report_phone": (400, 860, "dark")}
#: Time in which the page must be complete, and between two looks at it, seconds.
LONGEST_S, LOOK_S = 180.0, 3.0
#: Least standard deviation of the page's right half with images, of 255.
LOADED = 35.0
#: Largest size of a picture, bytes.
MOST_BYTES = 400_000
#: How a browser without graphics card draws, also for root.
ARGUMENTS = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-sandbox",
]


def main() -> None:
    """Simulate and track a flight in a temporary folder, and keep the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "pictures", help="folder of the pictures"
    )
    parser.add_argument("--frames", type=int, default=FRAMES, help="number of frames of the flight")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="size of the images per size of the dataset's"
    )
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        root = Path(temporary)
        sequence, tracks = root / "Simulated_Data" / SCENARIO, root / "tracks.csv"
        cache = ("--cache", root / "cache")
        run("simulate", SCENARIO, "--out", root, "--frames", options.frames, "--scale", options.scale)
        run("track", sequence, "--out", tracks, *cache)
        run("view", tracks, sequence, "--save", root / "flight.rrd", *cache)
        run("overlay", tracks, sequence, "--out", root, "--mosaic")
        run("report", tracks, sequence, "--out", root / "report.html")
        path = shutil.which("chromium") or shutil.which("google-chrome")
        chromium = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        pictures = {
            "viewer": photograph(root / "flight.rrd", chromium),
            "overlay": list(read_frames(probe(root / "mosaic.mp4")))[round(MOMENT * options.frames)],
        }
        for name, (width, height, scheme) in REPORTS.items():
            page = chromium.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.goto((root / "report.html").as_uri())
            page.wait_for_selector(".scene canvas")
            page.evaluate(f"document.querySelector('.scene').scene.seek({MOMENT * options.frames / 25})")
            pictures[name] = look(page)
        chromium.close()
    for name, picture in pictures.items():
        (options.out / f"{name}.png").write_bytes(small_png(picture))


def run(*arguments: object) -> None:
    """Run `psotrack`."""
    subprocess.run([sys.executable, "-m", "psotrack", *map(str, arguments), "--quiet"], check=True)


def photograph(path: Path, chromium) -> np.ndarray:
    """The viewer's page with a flight, as soon as it does not change any more."""
    with viewer_program(path, web=True) as program:
        width, height = WINDOW_WH
        page = chromium.new_page(viewport={"width": width, "height": height}, color_scheme="dark")
        page.goto(program.page)
        until_loaded(page)
        # The viewer plays as soon as the flight is there; Space pauses.
        page.mouse.move(width // 4, 12)
        page.keyboard.press("Space")
        left, right = SLIDER_X_PX
        page.mouse.click(left + MOMENT * (right - left), SLIDER_Y_PX)
        # Away from everything that explains itself under the mouse.
        page.mouse.move(width // 4, 12)
        return at_rest(page)


def look(page) -> np.ndarray:
    """A picture of the page after a while."""
    time.sleep(LOOK_S)
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def until_loaded(page) -> None:
    """Wait until the images of the cameras are there: until then the right half is of few colours."""
    end_s = time.monotonic() + LONGEST_S
    while look(page)[:, WINDOW_WH[0] * 6 // 10 :].std() < LOADED:
        if time.monotonic() > end_s:
            sys.exit(f"the viewer's page is not loaded after {LONGEST_S:.0f} s")


def at_rest(page) -> np.ndarray:
    """The picture of a page that has not changed between two looks."""
    end_s, before = time.monotonic() + LONGEST_S, look(page)
    while not np.array_equal(now := look(page), before):
        if time.monotonic() > end_s:
            sys.exit(f"the viewer's page has not come to rest in {LONGEST_S:.0f} s")
        before = now
    return now


def small_png(picture: np.ndarray) -> bytes:
    """A picture of at most `MOST_BYTES`: with fewer colours, then smaller."""
    for width in (1600, 1400, 1200, 1000, 800):
        scale = min(1.0, width / picture.shape[1])
        scaled = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for levels in (64, 32, 24):
            step = 256 / levels
            coarse = np.clip(np.round(scaled / step) * step, 0, 255).astype(np.uint8)
            png = cv2.imencode(".png", coarse, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
            if len(png) <= MOST_BYTES:
                return png
    sys.exit("the picture does not fit into its size")


if __name__ == "__main__":
    main()
