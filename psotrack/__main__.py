"""The program `psotrack`; `python -m psotrack` is the same."""

from __future__ import annotations

import signal
import sys
import time

from psotrack.support.interrupts import Terminated, end, orderly_interrupts


def main() -> None:
    """Run the command line; Ctrl-C and SIGTERM end it with one line, and exit codes 130 and 143."""
    started = time.perf_counter()
    try:
        with orderly_interrupts():
            # Imported here, so that signals are answered during the import too.
            from psotrack.cli import main as run

            run(started)
            sys.exit()
    except Terminated:
        end(signal.SIGTERM)
    except KeyboardInterrupt:
        end(signal.SIGINT)


if __name__ == "__main__":
    main()
