"""The time of compiling: measured over all threads, and apart from the time of tracking."""

import threading
import time
from pathlib import Path

import jax
import pytest
from small_sweeps import SETTINGS, small_sequence

from psotrack.pipeline import running, speed_in_words
from psotrack.support import measured_compiling
from psotrack.sweeps import sweep

#: Time that JAX needs to trace a function of these tests, seconds.
TRACING_S = 1.5


def compile_something(x: float = 1.0) -> None:
    """Call a new compiled function, whose tracing takes `TRACING_S`."""

    def slow_to_trace(x: jax.Array) -> jax.Array:
        time.sleep(TRACING_S)
        return x + 1

    jax.jit(slow_to_trace)(x)


def test_threads_that_compile_at_the_same_time_count_once() -> None:
    with measured_compiling() as compile_s:
        assert compile_s() == 0
        threads = [threading.Thread(target=compile_something) for _ in range(2)]
        began = time.monotonic()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wall_s = time.monotonic() - began
        measured_s = compile_s()
    assert TRACING_S <= measured_s <= wall_s + 0.1
    # Nobody measures any longer.
    compile_something()
    assert compile_s() == measured_s


@pytest.mark.slow
def test_whatever_compiles_is_not_in_the_time_of_tracking(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch of a sweep compiles for each device on which it runs, and the cells after it do not."""
    root, track = small_sequence(tmp_path_factory), running.track_silhouettes

    def compile_and_track(*args: object, **kwargs: object) -> object:
        compile_something()
        return track(*args, **kwargs)

    grid = {"sequences": ["S01_D2_A"], "settings": SETTINGS}
    sweep(grid, tmp_path / "warm", data=root, cache=root / "cache").rows()
    monkeypatch.setattr(running, "track_silhouettes", compile_and_track)
    (row,) = sweep(grid, tmp_path / "out", data=root, cache=root / "cache").rows().to_dict("records")
    assert row["seconds.compile"] >= TRACING_S
    assert row["seconds.track"] < TRACING_S
    assert row["track_ms_per_frame"] == pytest.approx(1e3 * row["seconds.track"] / row["frames"])


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (0.061, "16 times slower than the video"),
        (0.0077, "130 times slower than the video"),
        (2.0, "2 times faster than the video"),
        (0.99, "as fast as the video"),
    ],
)
def test_a_speed_in_words(factor: float, words: str) -> None:
    assert speed_in_words(factor) == words
