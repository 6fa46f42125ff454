"""Stored programs: a second process does not trace, results keep their bytes, and unusable files are replaced."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

import psotrack

#: A program that smooths a track, and prints a digest of the result's bytes.
SMOOTHING = """
import hashlib, logging, os, sys, threading
import jax
import numpy as np
from psotrack.tracking.motion import Measurements, motion_params, smooth
from psotrack.settings import MotionSettings
from psotrack.support import keep_compiled, load_ahead
logging.basicConfig(level=logging.INFO, format="%(message)s (%(threadName)s)")
if len(sys.argv) > 1:
    keep_compiled(sys.argv[1])
if "DEVICE" in os.environ:
    jax.config.update("jax_default_device", jax.devices()[int(os.environ["DEVICE"])])
if "ahead" in sys.argv:
    before = threading.enumerate()
    load_ahead()
    for thread in set(threading.enumerate()) - set(before):
        thread.join()
frames = 12
measured_m = np.random.default_rng(0).normal(size=(frames, 2, 3))
covariance_m2 = np.broadcast_to(1e-4 * np.eye(3), (frames, 2, 3, 3))
found = np.ones((frames, 2), bool)
measured = Measurements(np.arange(frames) / 25, measured_m, covariance_m2, found)
tracks = smooth(measured, motion_params(MotionSettings(), 2))
print(hashlib.sha256(b"".join(part.tobytes() for part in vars(tracks).values())).hexdigest())
"""
#: A program that calls LAPACK, which JAX makes ready when it lowers a function, and one with a class of its own.
OTHERS = """
import logging, sys
from dataclasses import dataclass
from functools import partial
import jax.numpy as jnp
import numpy as np
from psotrack.support import keep_compiled, stored_jit
logging.basicConfig(level=logging.INFO, format="%(message)s")
keep_compiled(sys.argv[1])

@stored_jit
def largest_eigenvalue(matrix):
    return jnp.linalg.eigvalsh(matrix)[-1]

@dataclass(frozen=True)
class Foreign:
    factor: int

@partial(stored_jit, static_argnames="foreign")
def multiplied(value, foreign):
    return value * foreign.factor

print(largest_eigenvalue(np.diag(np.float32([1, 5, 3]))), multiplied(np.float32(2), Foreign(3)))
"""


def start(
    program: str, folder: Path | None, package: Path | None = None, *options: str, **variables: str
) -> subprocess.Popen[str]:
    """Start a program that logs its tracing; the package may be a copy in a folder."""
    environment = environment_without_jax_settings() | {"JAX_LOG_COMPILES": "1"} | variables
    source = Path(psotrack.__file__).parents[1] if package is None else package
    environment["PYTHONPATH"] = str(source)
    return subprocess.Popen(
        [sys.executable, "-c", program, *([] if folder is None else [str(folder)]), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        # With "-c", the current folder goes before the others.
        cwd=source,
    )


def run(
    program: str, folder: Path | None, package: Path | None = None, *options: str, **variables: str
) -> tuple[str, str]:
    """What a program prints and what it logs."""
    process = start(program, folder, package, *options, **variables)
    printed, log = process.communicate()
    assert process.returncode == 0, log
    return printed, log


def traces(log: str, function: str) -> bool:
    """Whether a process traced a function."""
    return any("Finished tracing" in line and f" {function} " in line for line in log.splitlines())


def stored(folder: Path) -> Path:
    (found,) = folder.glob("*._smoothed-*.program")
    return found


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with a stored program, and what the process that stored the program printed."""
    folder = tmp_path_factory.mktemp("stored")
    printed, log = run(SMOOTHING, folder)
    assert traces(log, "_smoothed")
    return folder, printed


def test_a_second_process_loads_the_program_and_does_not_trace(filled: tuple[Path, str]) -> None:
    folder, printed = filled
    again, log = run(SMOOTHING, folder)
    assert again == printed
    assert not traces(log, "_smoothed")
    assert "loaded the compiled program psotrack.tracking.motion.smoothing._smoothed" in log


def test_a_thread_loads_the_programs_of_the_last_run_ahead(filled: tuple[Path, str]) -> None:
    folder, printed = filled
    again, log = run(SMOOTHING, folder, None, "ahead")
    assert again == printed
    assert not traces(log, "_smoothed")
    loaded = [line for line in log.splitlines() if line.startswith("loaded the compiled program")]
    assert len(loaded) == len(list(folder.glob("*.program")))
    assert not any("(MainThread)" in line for line in loaded)


def test_programs_of_other_devices_are_passed_over_in_silence(
    filled: tuple[Path, str], tmp_path: Path
) -> None:
    """A sweep stores programs of several devices; a run on one device loads all of them ahead."""
    folder = shutil.copytree(filled[0], tmp_path / "stored")
    run(SMOOTHING, folder, None, XLA_FLAGS="--xla_force_host_platform_device_count=2", DEVICE="1")
    assert len(list(folder.glob("*._smoothed-*.program"))) == 2
    again, log = run(SMOOTHING, folder, None, "ahead")
    assert again == filled[1]
    assert "compiled again" not in log
    assert not traces(log, "_smoothed")


def test_without_a_folder_the_result_has_the_same_bytes(filled: tuple[Path, str]) -> None:
    printed, log = run(SMOOTHING, None)
    assert printed == filled[1]
    assert traces(log, "_smoothed")


def changed_byte(content: bytes) -> bytes:
    """The content with another byte in its middle."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(changed_byte, id="a byte"),
        pytest.param(lambda content: content[:1000], id="cut short", marks=pytest.mark.slow),
        pytest.param(lambda content: b"", id="empty", marks=pytest.mark.slow),
        pytest.param(lambda content: b"foreign" * 99, id="foreign", marks=pytest.mark.slow),
    ],
)
def test_a_damaged_or_foreign_file_is_named_and_replaced(filled, tmp_path, change) -> None:
    folder = shutil.copytree(filled[0], tmp_path / "stored")
    whole = stored(folder).read_bytes()
    stored(folder).write_bytes(change(whole))
    printed, log = run(SMOOTHING, folder)
    assert printed == filled[1]
    assert f"{stored(folder)} is damaged or no program of psotrack" in log
    assert traces(log, "_smoothed")
    assert not traces(run(SMOOTHING, folder)[1], "_smoothed")


def test_another_source_makes_another_program(filled: tuple[Path, str], tmp_path: Path) -> None:
    """The same source elsewhere loads the stored program; with one more line it is compiled again."""
    package, folder = tmp_path / "copy", shutil.copytree(filled[0], tmp_path / "stored")
    shutil.copytree(Path(psotrack.__file__).parent, package / "psotrack")
    assert not traces(run(SMOOTHING, folder, package)[1], "_smoothed")
    with (package / "psotrack" / "motion" / "kalman.py").open("a", encoding="utf-8") as file:
        file.write("#\n")
    printed, log = run(SMOOTHING, folder, package)
    assert printed == filled[1]
    assert traces(log, "_smoothed")
    assert len(list(folder.glob("*._smoothed-*.program"))) == 2


@pytest.mark.slow
def test_processes_may_use_a_folder_at_once(filled: tuple[Path, str], tmp_path: Path) -> None:
    together = [start(SMOOTHING, tmp_path) for _ in range(3)]
    assert {process.communicate()[0] for process in together} == {filled[1]}
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]
    assert not traces(run(SMOOTHING, tmp_path)[1], "_smoothed")


def test_a_folder_that_cannot_be_written_is_no_error(filled: tuple[Path, str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(SMOOTHING, tmp_path / "file" / "compiled")[0] == filled[1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits on the size of files are a matter of Unix")
def test_a_full_disk_costs_no_result_and_leaves_no_program_cut_short(
    filled: tuple[Path, str], tmp_path: Path
) -> None:
    """A limit on the size of files stands for a full disk. JAX itself leaves entries cut short, which are not used."""
    limited = (
        "import resource, sys; sys.dont_write_bytecode = True; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (999, 999))"
    )
    assert run(limited + SMOOTHING, tmp_path)[0] == filled[1]
    assert not [
        path.name for path in tmp_path.iterdir() if path.suffix == ".program" or "partial" in path.name
    ]
    assert run(SMOOTHING, tmp_path)[0] == filled[1]
    printed, log = run(SMOOTHING, tmp_path)
    assert printed == filled[1]
    assert not traces(log, "_smoothed")


def test_a_loaded_program_may_call_lapack(tmp_path: Path) -> None:
    """The first process, which traces, and the second print the largest eigenvalue, 5, and 2 * 3."""
    printed, log = run(OTHERS, tmp_path)
    again, log_again = run(OTHERS, tmp_path)
    assert printed == again == "5.0 6.0\n"
    assert traces(log, "largest_eigenvalue")
    assert not traces(log_again, "largest_eigenvalue")


def test_a_program_with_a_class_from_outside_of_the_package_is_not_stored(tmp_path: Path) -> None:
    """The source of the class is not part of the key: a changed class would be served an outdated program."""
    for _ in range(2):
        _, log = run(OTHERS, tmp_path)
        assert traces(log, "multiplied")
    assert not list(tmp_path.glob("*multiplied*.program"))
    assert os.listdir(tmp_path)


def test_programs_that_nobody_uses_any_more_are_removed(filled: tuple[Path, str], tmp_path: Path) -> None:
    """A program that is loaded counts as used; the time limit is a month."""
    folder = tmp_path / "programs"
    shutil.copytree(filled[0], folder)
    used = stored(folder)
    unused, recent = folder / "unused.program", folder / "recent.program"
    for path, days in ((used, 31), (unused, 31), (recent, 29)):
        path.touch()
        os.utime(path, (time.time() - days * 86400,) * 2)
    run(SMOOTHING, folder)
    _, log = run(OTHERS, folder)  # stores a program
    assert "removed the compiled program unused.program" in log
    assert used.exists()
    assert recent.exists()
    assert not unused.exists()
