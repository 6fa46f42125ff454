"""Settings of the test session: types and shapes are checked, JAX is strict, compiled programs are shared."""

import contextlib
import importlib
import os
import pkgutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# The user's terminal and JAX settings must not decide any test. All processes of the suite (workers and commands that
# tests start) share one folder of compiled programs, which is kept between runs. JAX reads the variables on import.
os.environ["COLUMNS"] = "80"
# Commands write lines about long work where there is no terminal; how long work takes must not decide any test.
os.environ["PSOTRACK_PROGRESS"] = "none"
# A test that opens a video with OpenCV itself would switch FFmpeg's messages on for later tests of the process.
os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "-8"
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(__file__).parents[1] / ".compiled")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
# Most programs of the tests take longer to compile than to run. XLA compiles in a third of the time if it leaves out
# LLVM's optimisations and uses its older emitters of fused operations. The operations are the same; rounding may differ
# in the last bits. Users, and the results of the experiments, have XLA's own settings.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"

import jax
import jaxtyping
import pytest
from hypothesis import HealthCheck, settings

# jaxtyping and beartype check the types and shapes of the annotated calls of the package. The hook must be installed
# before the package is imported. The checks take a third to a half of the time, so only `make nightly` asks for them.
if os.environ.get("PSOTRACK_TYPE_CHECKS") == "on":
    jaxtyping.install_import_hook("psotrack", "checked_types.checked")

from helpers import Output, made_once
from worlds import make_two_flights

# Conversions such as int32 to float32 must be explicit: an implicit promotion loses bits of exact sums.
# Rank promotion stays allowed: the package broadcasts particles x drones x cameras against cameras on purpose.
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The same examples in every run, so that a failure can be repeated. No deadline, because the first example of a
# compiled function includes the compilation.
settings.register_profile(
    "psotrack", derandomize=True, deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("psotrack")


@pytest.fixture(scope="module")
def optimised() -> Iterator[None]:
    """XLA optimises the programs of the module: for programs that run for longer than they compile.

    JAX would also use a program that an earlier test of the process compiled without optimisations.
    """
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()
    yield
    jax.config.update("jax_disable_most_optimizations", True)
    jax.clear_caches()


#: A folder with the sequences `flight` and `second`, and `tracks.csv` of the first; no test changes it.
world = made_once("two_flights", make_two_flights)


#: The first of them: a recording of two drones by three cameras.
flight = made_once("two_flights", make_two_flights, "flight")


@pytest.fixture
def run_psotrack(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Output]:
    """Runs `psotrack` with some arguments in this process."""
    from psotrack import cli

    def call(*arguments: object) -> Output:
        monkeypatch.setattr(sys, "argv", ["psotrack", *map(str, arguments)])
        capfd.readouterr()
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        return Output(code, *capfd.readouterr())

    return call


@pytest.fixture
def start_python() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts Python with some arguments, in a session of its own, which ends with the test."""
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: object, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env=env,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        with process, contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Import the whole package, so that a failure can be repeated.

    Hypothesis also draws the constants that it finds in imported modules. Without this import, the examples of a test
    would depend on the modules that earlier tests imported.
    """
    import psotrack

    for module in pkgutil.walk_packages(psotrack.__path__, "psotrack."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
