"""Make the pictures of a report that the documentation shows: wide and light, narrow and dark.

python experiments/report_picture.py      # needs Chromium and the package playwright
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import _results

from psotrack import demo
from psotrack.show.flights import read_flight
from psotrack.show.reports import write_flight_report

#: Windows: width and height in pixels, colour scheme, and the moment that the 3D view shows, seconds.
WINDOWS = {"report.png": (1280, 860, "light", 2.2), "report_phone.png": (400, 860, "dark", 2.2)}


def main() -> None:
    """Run the demonstration in a temporary folder, write its report, and keep pictures of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "pictures", help="folder of the pictures"
    )
    options = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("report_picture: expected Chromium on this machine, found none")
    started = _results.Run("report_picture")
    with tempfile.TemporaryDirectory() as folder:
        made = demo.run(Path(folder))
        sequence = made.picture.parent / "Simulated_Data" / demo.NAME
        page = Path(folder) / "report.html"
        write_flight_report(page, read_flight([made.picture.parent / "tracks.csv"], sequence))
        pictures = take(page, chromium, options.out)
    started.save(options.out, files=pictures)


def take(page: Path, chromium: str, out: Path) -> list[Path]:
    """Pictures of a page in the windows."""
    from playwright.sync_api import sync_playwright

    taken = []
    with sync_playwright() as programs:
        browser = programs.chromium.launch(
            executable_path=chromium,
            args=[
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--ignore-gpu-blocklist",
                "--no-sandbox",
            ],
        )
        for name, (width, height, scheme, moment_s) in WINDOWS.items():
            window = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            window.goto(page.as_uri())
            window.wait_for_selector(".scene canvas")
            window.evaluate(f"document.querySelector('.scene').scene.seek({moment_s})")
            window.screenshot(path=out / name)
            taken.append(out / name)
        browser.close()
    return taken


if __name__ == "__main__":
    main()
