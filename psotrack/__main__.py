"""The program `psotrack`; `python -m psotrack` is the same."""

from __future__ import annotations

import contextlib
import os
import sys
import time


def main() -> None:
    """Run the command line; Ctrl-C ends it with one line and exit code 2."""
    started = time.perf_counter()
    try:
        # Imported here, so that Ctrl-C is answered during the import too.
        from psotrack.cli import main as run

        run(started)
    except KeyboardInterrupt:
        sys.stderr.write(
            "psotrack: interrupted; earlier results are unchanged; run the command again to finish\n"
        )
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        # The usual end of the interpreter would wait for a computation of JAX, which cannot be interrupted: all blocks
        # have ended, temporary files are removed, and worker processes have stopped.
        os._exit(2)


if __name__ == "__main__":
    main()
