"""Compiled programs: what users set for programs of their own, and the cache on disk, which is repaired."""

import os
import threading
import time

import jax
import pytest
from helpers import environment_without_jax_settings

from psotrack.support import compiled, drop_programs_if_many, keep_compiled, measured_compiling

#: A program that is stored although it compiles fast; it is needed again, and again after each damage to its entry.
PROGRAM = """
import sys
import warnings
from pathlib import Path
import jax
from psotrack.support import compiled
warnings.simplefilter("always")
compiled.WORTH_KEEPING_S = 0.0
folder = Path(sys.argv[1])
compiled.keep_compiled(folder)
def twice_the_sine(x):
    return 2 * jax.numpy.sin(x)
def use():
    jax.clear_caches()
    print(f"{jax.jit(twice_the_sine)(0.5):.6f}")
use()
entries = list(folder.glob("jit_twice_the_sine-*-cache"))
for entry in entries:
    whole, written_ns = entry.read_bytes(), entry.stat().st_mtime_ns
    use()
    print(entry.stat().st_mtime_ns == written_ns)
    for damaged in (b"", whole[:300], whole[:-1], b"foreign" * 99):
        entry.write_bytes(damaged)
        use()
    print(len(entry.read_bytes()) / len(whole))
"""
#: Runs psotrack with the words of each argument.
COMMANDS = """
import sys
from psotrack.cli import main
for words in sys.argv[1:]:
    sys.argv = ["psotrack", *words.split()]
    main()
"""
#: What researchers set for programs of their own.
JAX_SETTINGS = {
    "JAX_ENABLE_X64": "1",
    "JAX_DEBUG_NANS": "1",
    "JAX_DEBUG_INFS": "1",
    "JAX_DISABLE_JIT": "1",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
}
#: What the program prints: 2 sin(0.5).
RESULT = "0.958851"


def test_a_program_is_compiled_once_and_a_damaged_entry_is_named_and_replaced(start_python, tmp_path):
    """JAX by itself never replaces an entry, such as one that a full disk cut short."""
    folder, no_folder = tmp_path / "compiled", tmp_path / "file" / "compiled"
    (tmp_path / "file").write_text("")
    processes = [
        start_python("-c", PROGRAM, each, env=environment_without_jax_settings())
        for each in (folder, no_folder)
    ]
    (printed, said), without = (process.communicate() for process in processes)
    *results, size = printed.splitlines()
    assert results == [RESULT, RESULT, "True", *[RESULT] * 4]
    line = f"{folder}: damaged entry jit_twice_the_sine; the program is compiled again"
    assert said.splitlines() == [line] * 4
    # An entry holds its compile time.
    assert float(size) == pytest.approx(1, rel=0.1)
    assert without == (f"{RESULT}\n", "")


def test_a_users_own_cache_folder_is_kept(tmp_path):
    """Here it is the suite's folder, which an environment variable names."""
    own = jax.config.jax_compilation_cache_dir
    keep_compiled(tmp_path / "default")
    assert jax.config.jax_compilation_cache_dir == own
    assert own != str(tmp_path / "default")


def test_programs_are_dropped_when_the_process_has_many_memory_maps(monkeypatch, tmp_path):
    """The limit is replaced, and so is the dropping: other tests of this process use their programs again."""
    calls = []
    (tmp_path / "maps").write_text("a map\n" * 60)
    monkeypatch.setattr(compiled, "_MAP_LIMIT", tmp_path / "limit")
    monkeypatch.setattr(compiled, "_MAPS", tmp_path / "maps")
    monkeypatch.setattr(compiled.jax, "clear_caches", lambda: calls.append("cleared"))
    for limit, is_dropped in ((1_000_000, False), (100, True)):
        (tmp_path / "limit").write_text(f"{limit}\n")
        assert drop_programs_if_many() == is_dropped
    assert calls == ["cleared"]
    assert [drop_programs_if_many(most_maps=most) for most in (60, 59)] == [False, True]
    # Nothing is dropped where the system has no limit.
    (tmp_path / "maps").unlink()
    assert not drop_programs_if_many(most_maps=0)


def test_threads_that_compile_at_the_same_time_count_once():
    tracing_s = 0.2

    def compile_something():
        def slow_to_trace(x):
            time.sleep(tracing_s)
            return x + 1

        jax.jit(slow_to_trace)(1.0)

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
    # JAX and this test read different clocks.
    assert tracing_s <= measured_s <= wall_s + 0.1
    # Nobody measures any longer.
    compile_something()
    assert compile_s() == measured_s


@pytest.mark.slow
def test_settings_of_jax_for_other_programs_change_no_result(start_python, flight, tmp_path):
    """Neither of both trackers together, of smoothing and clocks, of tracking step by step, nor of drawn boxes."""
    swarm = "--particles 8 --iterations 4 --drone-size 0.4,0.4,0.2"

    def done(name, **variables):
        folder = tmp_path / name
        words = [
            f"track {flight} --out {folder}/fused.csv --method fused --detections blobs --smooth --clocks auto {swarm}",
            f"track {flight} --out {folder}/causal.csv --causal --most-drones 2 {swarm}",
            f"overlay {flight.parent}/tracks.csv {flight} --out {folder}/shown.mp4 --frames 2",
        ]
        process = start_python("-c", COMMANDS, *words, env={**os.environ, **variables})
        said = process.communicate()[1]
        return process.returncode, said, folder

    (code, said, plain), (again, said_again, other) = done("plain"), done("other", **JAX_SETTINGS)
    assert (code, again) == (0, 0), f"{said}{said_again}"
    for name in ("fused.csv", "causal.csv"):
        assert (plain / name).read_bytes() == (other / name).read_bytes()
    code, said, _ = done("tpu", JAX_PLATFORMS="tpu")
    assert code == 2
    assert said.startswith("psotrack: JAX_PLATFORMS: expected devices that JAX finds, found ")
    assert said.count("\n") == 1
