"""Sweeps as tasks of a Dask cluster: when a worker is killed, its cell runs again, and the results are complete."""

import functools
import json
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from helpers import AT_A_TERMINAL, assert_refused, listening_at
from small_sweeps import all_rows, environment, grid_file, small_sequence, wait_until

from psotrack.sweeps import Cluster, Inputs, Store, read_grid, runner

pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
psutil = pytest.importorskip("psutil", reason="comes with Dask")

#: Code that every worker runs first: one worker kills itself just before it moves its cell's file to its place.
DYING = """
import contextlib, os, signal, sys
from pathlib import Path

def die_once(event, arguments):
    if event == "os.rename" and Path(arguments[1]).match("cells/*.parquet"):
        with contextlib.suppress(FileExistsError):
            Path(os.environ["DIED"]).open("x").close()
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(die_once)
"""


root = small_sequence


@pytest.mark.slow
def test_a_worker_is_killed_and_its_cell_runs_again(start_python, run_psotrack, root, tmp_path):
    results, died = tmp_path / "results", tmp_path / "died"
    dying = tmp_path / "dying.py"
    dying.write_text(DYING)
    more = {
        "DIED": str(died),
        "DASK_DISTRIBUTED__WORKER__PRELOAD": str(dying),
        # The test must not fail on a slow machine: Dask's default timeout is half a minute.
        "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "600s",
        "DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "600s",
    }
    words = ("sweep", grid_file(tmp_path, [2, 3, 4]), "--data", root, "--out", results, "--json", "-")
    local = ("--cluster", "local", "--workers", 2)
    process = start_python("-m", "psotrack", *words, *local, env=environment(root) | more)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert died.exists()
    assert json.loads(out) == {"finished": 3, "failed": 0, "left": 0}
    assert sorted(all_rows(results)["settings.swarm.iterations"]) == [2, 3, 4]
    (noted,) = (results / "_runs").glob("*.json")
    assert json.loads(noted.read_text())["cells"] == 3
    # All cells are finished, so no cluster is needed, and the address without a cluster is no error.
    again = run_psotrack(*words, "--cache", root / "cache", "--cluster", "tcp://127.0.0.1:1")
    assert json.loads(again.out) == {"finished": 0, "failed": 0, "left": 3}


def test_without_dask_one_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert_refused(Cluster, "expected Dask, found ", "; pip install '.[dask]'", unchanged=tmp_path)


@pytest.mark.nightly
def test_a_local_cluster_listens_on_the_loopback_only_and_ctrl_c_ends_it_with_one_line(
    start_python, root, tmp_path
):
    results = tmp_path / "results"
    # A cell of minutes, so that Ctrl-C comes while a worker computes.
    grid = grid_file(tmp_path, [100_000], runs=100)
    words = ("sweep", grid, "--data", root, "--out", results, "--cluster", "local", "--workers", 2)
    process = start_python("-c", AT_A_TERMINAL, *words, env=environment(root))
    line = process.stderr.readline()
    wait_until(lambda: list(results.glob("cells/*.lock")))
    time.sleep(1.0)  # The worker is in the computation.
    workers = psutil.Process(process.pid).children(recursive=True)
    addresses = listening_at(process.pid)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    listens = r"the cluster listens at tcp://127\.0\.0\.1:\d+, for programs on this computer only\n"
    assert re.fullmatch(listens, line)
    assert addresses == {"127.0.0.1"}
    assert err == "psotrack: interrupted; earlier results are unchanged; run the command again to finish\n"
    assert process.returncode == 130
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert alive == []


@pytest.mark.parametrize(
    ("address", "warned"),
    [
        ("tcp://scheduler.lab:8786", True),
        ("tcp://127.0.0.1:8786", False),
        ("localhost:8786", False),
        ("tcp://[::1]:8786", False),
        ("tls://10.0.0.5:8786", False),
    ],
)
def test_an_address_that_is_neither_tls_nor_this_machine_warns_in_a_line(
    tmp_path, monkeypatch, caplog, address, warned
):
    def refuse(*_):
        raise OSError("nobody listens")

    monkeypatch.setattr("distributed.Client", refuse)
    cells = list(read_grid(grid_file(tmp_path, [2])).cells())
    ran = runner.run_on_cluster(Cluster(address), cells, Inputs(tmp_path, tmp_path), Store(tmp_path))
    assert_refused(functools.partial(next, ran), "nobody listens", unchanged=tmp_path)
    lines = [record.getMessage() for record in caplog.records if "TLS" in record.getMessage()]
    assert len(lines) == warned
    assert all(line.startswith(f"--cluster {address}: ") for line in lines)


def _certificates(folder):
    """A certificate that signs itself, and Dask's settings with it."""
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test"]
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    settings = {"CA_FILE": certificate}
    for role in ("SCHEDULER", "WORKER", "CLIENT"):
        settings |= {f"{role}__KEY": key, f"{role}__CERT": certificate}
    return {f"DASK_DISTRIBUTED__COMM__TLS__{name}": str(path) for name, path in settings.items()}


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")
def test_a_sweep_on_a_cluster_with_tls(start_python, run_psotrack, root, tmp_path):
    """The commands of the page about clusters: a scheduler and a worker with TLS, and a sweep."""
    tls = _certificates(tmp_path)
    file = tmp_path / "scheduler.json"
    listening = ["--protocol", "tls", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", file]
    start = functools.partial(start_python, "-m", env=environment(root) | tls)
    start("distributed.cli.dask_scheduler", "--port", "0", *listening)
    wait_until(file.exists)
    address = json.loads(file.read_text())["address"]
    assert address.startswith("tls://127.0.0.1:")
    start("distributed.cli.dask_worker", "--nthreads", "1", *listening)
    grid = grid_file(tmp_path, [2])
    words = ("sweep", grid, "--data", root, "--cache", root / "cache", "--cluster", address, "--json", "-")
    # What Dask reads in the variables when it is imported.
    names = [name.removeprefix("DASK_").lower().replace("__", ".") for name in tls]
    with dask.config.set(dict(zip(names, tls.values(), strict=True))):
        done = run_psotrack(*words, "--out", tmp_path / "results").ended()
    assert json.loads(done.out) == {"finished": 1, "failed": 0, "left": 0}
    stranger = run_psotrack(*words, "--out", tmp_path / "other").ended(2)
    assert stranger.err.startswith("psotrack: --cluster: expected a Dask scheduler")
