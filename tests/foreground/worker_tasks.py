"""What worker processes do in tests; they import this module alone, and so start fast."""

import os
import signal
import threading

from psotrack.support import atomic_write


def double(task, advance):
    """Twice a number; a negative one ends the process."""
    if task < 0:
        os._exit(3)
    advance(task)
    return 2 * task


def fail_and_be_ended(path, advance):
    """Fail with a folder of many files half written; SIGTERM comes while the folder is being removed."""
    num_files = 2000

    def end_soon():
        while len(os.listdir(temporary)) == num_files:
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    with atomic_write(path) as temporary:
        temporary.mkdir()
        for index in range(num_files):
            (temporary / f"{index}").touch()
        threading.Thread(target=end_soon, daemon=True).start()
        raise ValueError
