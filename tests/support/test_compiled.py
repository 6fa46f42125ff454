"""Compile cache on disk: entries are reused, damaged entries are replaced, and an unusable folder is no error."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import pytest
from helpers import environment_without_jax_settings

from psotrack.pipeline import speed_in_words
from psotrack.support import compiled, drop_programs_if_many, measured_compiling

#: A program that is stored although it compiles fast; it prints its result and the folder of JAX's compile cache.
PROGRAM = """
import sys
from pathlib import Path
import jax
from psotrack.support import compiled
compiled.WORTH_KEEPING_S = 0.0
compiled.keep_compiled(Path(sys.argv[1]))
def twice_the_sine(x):
    return 2 * jax.numpy.sin(x)
print(f"{jax.jit(twice_the_sine)(0.5):.6f}", jax.config.jax_compilation_cache_dir)
"""
#: More of the program: each file of damaged content becomes the entry, and the program is needed again.
AGAIN = """
import warnings
warnings.simplefilter("always")
folder = Path(sys.argv[1])
for number in range(len(list(folder.glob("*.damaged")))):
    (entry,) = folder.glob("jit_twice_the_sine-*-cache")
    entry.write_bytes((folder / f"{number}.damaged").read_bytes())
    jax.clear_caches()
    print(f"{jax.jit(twice_the_sine)(0.5):.6f}")
"""
#: What the program prints: 2 sin(0.5).
RESULT = "0.958851"


def run_program(program: str, folder: Path, **environment: str) -> tuple[str, str]:
    """Run a program; return what it prints on stdout and on stderr."""
    result = subprocess.run(
        [sys.executable, "-c", program, str(folder)],
        capture_output=True,
        text=True,
        env=environment_without_jax_settings() | environment,
        check=True,
    )
    return result.stdout, result.stderr


def run(folder: Path, **environment: str) -> list[str]:
    """Run the program without any output on stderr; return the number and the folder that it prints."""
    printed, said = run_program(PROGRAM, folder, **environment)
    assert said == ""
    return printed.rstrip("\n").split(" ", 1)


def entry(folder: Path) -> Path:
    (found,) = folder.glob("jit_twice_the_sine-*-cache")
    return found


def test_a_program_is_compiled_once_and_a_damaged_entry_is_named_and_replaced(tmp_path: Path) -> None:
    """JAX by itself never replaces an entry, such as one that a full disk cut short."""
    assert run(tmp_path) == [RESULT, str(tmp_path)]
    written, whole = entry(tmp_path).stat().st_mtime_ns, entry(tmp_path).read_bytes()
    damaged = [b"", whole[:300], whole[:-1], b"foreign" * 99]
    for number, content in enumerate(damaged):
        (tmp_path / f"{number}.damaged").write_bytes(content)
    assert run(tmp_path) == [RESULT, str(tmp_path)]
    assert entry(tmp_path).stat().st_mtime_ns == written
    printed, said = run_program(PROGRAM + AGAIN, tmp_path)
    assert printed.splitlines()[1:] == [RESULT] * len(damaged)
    line = "damaged entry jit_twice_the_sine; the program is compiled again"
    assert said.splitlines() == [f"{tmp_path}: {line}"] * len(damaged)
    assert entry(tmp_path).stat().st_size == pytest.approx(len(whole), rel=0.1)  # It holds its compile time.


def test_a_users_own_cache_folder_is_kept_and_one_that_cannot_be_created_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file" / "compiled")[0] == RESULT
    own = tmp_path / "own"
    assert run(tmp_path / "default", JAX_COMPILATION_CACHE_DIR=str(own)) == [RESULT, str(own)]
    assert not (tmp_path / "default").exists()


@pytest.mark.parametrize(("limit", "dropped"), [("1000000", False), ("100", True)])
def test_programs_are_dropped_when_the_process_has_many_memory_maps(monkeypatch, tmp_path, limit, dropped):
    """The limit is replaced, and so is the dropping: other tests of this process use their programs again."""
    calls = []
    (tmp_path / "limit").write_text(f"{limit}\n")
    (tmp_path / "maps").write_text("a map\n" * 60)
    monkeypatch.setattr(compiled, "_MAP_LIMIT", tmp_path / "limit")
    monkeypatch.setattr(compiled, "_MAPS", tmp_path / "maps")
    monkeypatch.setattr(compiled.jax, "clear_caches", lambda: calls.append("cleared"))
    assert drop_programs_if_many() == dropped
    assert calls == ["cleared"] * dropped
    assert drop_programs_if_many(most_maps=60) is False
    assert drop_programs_if_many(most_maps=59) is True
    # Nothing is dropped where the system has no limit.
    monkeypatch.setattr(compiled, "_MAPS", tmp_path / "absent")
    assert not drop_programs_if_many(most_maps=0)


# --- the time of compiling, measured over all threads

#: Time that JAX needs to trace a function of the test, seconds.
TRACING_S = 0.3


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
