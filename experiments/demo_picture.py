"""Make the picture of `psotrack demo`, which the README shows, with its record.

python experiments/demo_picture.py
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import _results

from psotrack import demo


def main() -> None:
    """Run the demonstration in a temporary folder, and keep its picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "pictures", help="folder of the picture"
    )
    options = parser.parse_args()
    started = _results.Run("demo")
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(shutil.copy(demo.run(Path(folder)).picture, options.out))
    started.save(options.out, files=[picture])


if __name__ == "__main__":
    main()
