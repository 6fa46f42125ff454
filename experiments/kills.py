"""Kill commands at random moments, run them again, and compare the results with those of runs that were left alone.

    python experiments/kills.py --count 300 --out build/kills --seed 0

Each kill starts a command on a small recording, waits for a random part of the command's usual time, or for a file
that is being written, and sends SIGKILL, SIGTERM or SIGINT. Where two commands work in one folder, one or both are
killed; of a Dask cluster, also a worker alone. Then the command runs to its end. A kill fails if

- the results are other bytes than undisturbed (seconds, rates and versions of records are left out),
- a unit that was finished (a video, silhouettes of a camera, a cell of a sweep) is made once more,
- a temporary file or a process is left, or the next run needs a hand,
- SIGTERM or SIGINT do not end the command with one line, exit code 143 or 130, within a limit.

The folder keeps the outcome of each kill: the same call goes on where it was stopped, and a larger --count adds kills.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

#: Time to the end that is counted as a failure, seconds. The machine may be busy.
LONGEST_S = 2.0
#: Exit codes of signals that a command answers, and the first word of its line.
CODES = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
#: Time after which a command counts as hanging, seconds.
HANGS_S = 300.0
#: Keys of records whose values are those of the run, not of the result.
OF_THE_RUN = {
    "seconds",
    "real_time_factor",
    "real_time_factor_running",
    "versions",
    "device",
    "created",
    "started",
    "command",
    "digest",
    "machine",
}
FIELDS = ("number", "command", "signal", "victim", "phase", "seconds_to_end", "kept", "failure")


@dataclass(frozen=True)
class Command:
    """A command that is killed.

    Attributes:
        words: words of the command; `{given}` is the folder of the input, `{out}` the folder of the output.
        outputs: results in the folder of the output, files or folders.
        units: pattern of the files in the folder of the output that a second run keeps; "" where the second run makes
            all files anew.
        processes: number of the same commands that run at once, on one output.
        has_workers: whether the command has worker processes that may be killed alone.
    """

    words: str
    outputs: tuple[str, ...]
    units: str = ""
    processes: int = 1
    has_workers: bool = False

    def start(self, given: Path, out: Path) -> subprocess.Popen[str]:
        """Start the command."""
        return start(*(word.format(given=given, out=out) for word in self.words.split()))


QUICK = "--particles 20 --iterations 15 --reduction 2"
FLIGHT = "{given}/Simulated_Data/S02_D4_A"
SWEEP = Command(
    "sweep {given}/grid.toml --data {given} --out {out}/results --cache {given}/cache",
    ("results/cells",),
    units="results/cells/*.parquet",
)
COMMANDS = {
    "simulate": Command(
        "simulate S01_D2_A --out {out} --frames 12 --scale 0.2",
        ("Simulated_Data",),
        units="Simulated_Data/S01_D2_A/*.avi",
    ),
    "silhouettes": Command(
        f"detect {FLIGHT} --silhouettes --cache {{out}}/cache", ("cache",), units="cache/[0-9a-f]*/c/**/*"
    ),
    "track": Command(
        f"track {FLIGHT} --out {{out}}/tracks.csv {QUICK} --force --cache {{out}}/cache",
        ("tracks.csv", "tracks.json", "tracks.ambiguity.csv"),
        units="cache/[0-9a-f]*/c/**/*",
    ),
    "sweep": SWEEP,
    "two sweeps": replace(SWEEP, processes=2),
    "cluster": replace(SWEEP, words=f"{SWEEP.words} --cluster local --workers 2", has_workers=True),
    "labels": Command(
        f"simulate labels {FLIGHT} {{given}}/Simulated_Data/S01_D2_A --out {{out}}/labels "
        "--drone-size 0.3,0.3,0.15 --force",
        ("labels",),
    ),
    "localise": Command(
        "onboard localise {given}/Simulated_Data/S01_D2_A --drone dron1 --out {out}/poses.csv --force",
        ("poses.csv",),
    ),
    "export": Command(
        f"export {{given}}/tracks.csv {FLIGHT} --to mot --out {{out}}/mot --force",
        ("mot",),
    ),
    "pack": Command(
        f"archive {{given}}/tracks.csv {FLIGHT} --out {{out}}/flight.psotrack --force --cache {{given}}/cache",
        ("flight.psotrack",),
    ),
    "overlay": Command(
        f"overlay {{given}}/tracks.csv {FLIGHT} --out {{out}}/videos", ("videos",), units="videos/*.mp4"
    ),
    "report": Command(
        f"report {{given}}/tracks.csv {FLIGHT} --out {{out}}/report.html --force", ("report.html",)
    ),
}
GRID = """
sequences = ["S02_D4_A"]
runs = 2
[settings]
silhouettes.reduction = 2
swarm.iterations = 10
[grid]
swarm.particles = [10, 20]
"""


def main() -> None:
    """Kill, and print a table of commands and signals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="number of kills in all")
    parser.add_argument("--out", type=Path, default=Path("build/kills"), help="folder of inputs and outcomes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", default=",".join(COMMANDS), help="names of commands")
    options = parser.parse_args()
    names = options.commands.split(",")
    # Results may contain their paths, so all runs write to one place.
    given, place = options.out.resolve() / "given", options.out.resolve() / "place"
    if not (given / "finished").exists():
        prepare(given)
    outcomes = options.out / "outcomes.csv"
    done = read(outcomes)
    expected: dict[str, tuple[float, dict[str, str]]] = {}
    for number in range(options.count):
        if number in done:
            continue
        choice = random.Random(f"{options.seed} {number}")
        name = names[number % len(names)]
        if name not in expected:
            expected[name] = undisturbed(COMMANDS[name], given, place)
        outcome = kill(COMMANDS[name], choice, given, place, *expected[name])
        done[number] = {"number": number, "command": name, **outcome}
        with outcomes.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, FIELDS)
            if not file.tell():
                writer.writeheader()
            writer.writerow(done[number])
        print(
            f"{number + 1} of {options.count}: {name}, {outcome['signal']} to {outcome['victim']}, "
            f"{outcome['failure'] or 'as undisturbed'}",
            flush=True,
        )
    show([done[number] for number in range(options.count)], options.seed)


def prepare(given: Path) -> None:
    """Make the inputs: recordings, tracks, a cache, and a grid."""
    shutil.rmtree(given, ignore_errors=True)
    run("simulate", "S02_D4_A", "--out", given, "--frames", 12, "--scale", 0.35, "--no-onboard")
    run("simulate", "S01_D2_A", "--out", given, "--frames", 25, "--scale", 0.3)
    flight = FLIGHT.format(given=given)
    run("track", flight, "--out", given / "tracks.csv", *QUICK.split(), "--cache", given / "cache")
    (given / "grid.toml").write_text(GRID, encoding="utf-8")
    run("sweep", given / "grid.toml", "--data", given, "--out", given / "warm", "--cache", given / "cache")
    (given / "finished").touch()


def undisturbed(command: Command, given: Path, folder: Path) -> tuple[float, dict[str, str]]:
    """Seconds and results of a command that is left alone."""
    make_place(folder, given, with_programs=True)
    began_s = time.monotonic()
    process = command.start(given, folder)
    _, said = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"{command.words}: {said}")
    return time.monotonic() - began_s, digests(command.outputs, folder)


def make_place(folder: Path, given: Path, *, with_programs: bool) -> None:
    """Make the empty folder of the output, with or without the compiled programs."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "cache").mkdir(parents=True)
    if with_programs:
        shutil.copytree(given / "cache" / "compiled", folder / "cache" / "compiled")


@dataclass(frozen=True)
class Strike:
    """How a command is killed.

    Attributes:
        number: the signal.
        victim: "one" of the processes, "all" of them, or a "worker" of the first one.
        moment_s: time from the command's start, seconds.
        writing: whether to wait longer, until a file is being written.
    """

    number: signal.Signals
    victim: str
    moment_s: float
    writing: bool


def kill(
    command: Command,
    choice: random.Random,
    given: Path,
    folder: Path,
    usual_s: float,
    expected: dict[str, str],
) -> dict[str, object]:
    """Kill a command once, run the command again, and say what is wrong."""
    # Compiling takes longer than all other work; one kill in five meets a compiler.
    make_place(folder, given, with_programs=choice.random() < 0.8)
    strike = planned(command, choice, usual_s)
    processes = [command.start(given, folder) for _ in range(command.processes)]
    phase = wait_for(strike, processes, folder)
    faults: list[str] = []
    killed, took_s = send(strike, processes, phase, choice, faults)
    for process in processes:
        if process not in killed and (said := ended(process, faults)) and process.returncode != 0:
            faults.append(f"the other: code {process.returncode}: {said[-200:]!r}")
    if strike.number != signal.SIGKILL and (left := partial(folder)):
        faults.append(f"left {left[0].name}")
    before = stamps(command.units, folder)
    again = command.start(given, folder)
    said = ended(again, faults)
    # What had just finished is not made again.
    had_finished = any(process.returncode == 0 for process in killed)
    if again.returncode != 0 and not (had_finished and "--force" in said):
        faults.append(f"again: code {again.returncode}: {said[-200:]!r}")
    faults += faults_after_all(command, folder, before, expected)
    faults += faults_of_processes([*processes, again])
    return {
        "signal": strike.number.name,
        "victim": strike.victim,
        "phase": phase,
        "seconds_to_end": round(took_s, 2),
        "kept": len(before),
        "failure": "; ".join(faults),
    }


def planned(command: Command, choice: random.Random, usual_s: float) -> Strike:
    """Choose how the command is killed."""
    number = choice.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
    victim = choice.choice(("one", "all")) if command.processes > 1 else "one"
    if command.has_workers and choice.random() < 0.3:
        number, victim = signal.SIGKILL, "worker"
    writing = choice.random() < 0.5
    return Strike(number, victim, choice.uniform(0, usual_s), writing)


def wait_for(strike: Strike, processes: list[subprocess.Popen[str]], folder: Path) -> str:
    """Wait for the moment; says whether the first process is "over", "writing" a file, or doing "other" work."""
    # Until its first lines run, Python answers signals in its own way.
    while not all(map(answers, processes)):
        time.sleep(0.002)
    began_s = time.monotonic()
    while time.monotonic() - began_s < strike.moment_s and processes[0].poll() is None:
        time.sleep(0.002)
    while strike.writing and processes[0].poll() is None and not partial(folder):
        time.sleep(0.002)
    return "over" if processes[0].poll() is not None else "writing" if partial(folder) else "other"


def send(
    strike: Strike,
    processes: list[subprocess.Popen[str]],
    phase: str,
    choice: random.Random,
    faults: list[str],
) -> tuple[list[subprocess.Popen[str]], float]:
    """Send the signal, and judge how the processes end; gives those processes, and the seconds until their end."""
    if strike.victim == "worker":
        kill_worker(processes[0], choice)
        # The sweep goes on with another worker.
        return [], 0.0
    killed = processes if strike.victim == "all" else processes[:1]
    sent_s = time.monotonic()
    for process in killed:
        process.send_signal(strike.number)
    said = [ended(process, faults) for process in killed]
    took_s = time.monotonic() - sent_s
    if phase == "over" or strike.number not in CODES:
        return killed, took_s
    expected, word = CODES[strike.number]
    for process, line in zip(killed, said, strict=True):
        # A command may have just finished when the signal came.
        right = process.returncode == 0 and not line
        right |= process.returncode == expected and line.startswith(f"psotrack: {word}; ")
        if not right or line.count("\n") > 1:
            faults.append(f"code {process.returncode}: {line[-200:]!r}")
    if took_s > LONGEST_S:
        faults.append(f"{took_s:.1f} s to the end")
    return killed, took_s


def faults_after_all(
    command: Command, folder: Path, before: dict[str, tuple[int, int]], expected: dict[str, str]
) -> list[str]:
    """Units that were made once more, other results than undisturbed, and temporary files that are left."""
    faults = []
    after = stamps(command.units, folder)
    if made_again := [name for name, stamp in before.items() if after.get(name) != stamp]:
        faults.append(f"made once more: {made_again[0]}")
    if (found := digests(command.outputs, folder)) != expected:
        names = sorted(set(found.items()) ^ set(expected.items()))
        faults.append(f"other results: {names[0][0]}")
    if left := partial(folder):
        faults.append(f"left after all {left[0].name}")
    return faults


def faults_of_processes(processes: list[subprocess.Popen[str]]) -> list[str]:
    """Processes that the commands have started, and that still run after ten seconds."""
    end_s = time.monotonic() + 10
    while (alive := group_of(processes)) and time.monotonic() < end_s:
        time.sleep(0.1)
    return [f"{len(alive)} processes left"] if alive else []


def answers(process: subprocess.Popen[str]) -> bool:
    """Whether a command answers SIGTERM itself, or has ended."""
    if process.poll() is not None:
        return True
    lines = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii").splitlines()
    (caught,) = (int(line.split()[1], 16) for line in lines if line.startswith("SigCgt:"))
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def kill_worker(process: subprocess.Popen[str], choice: random.Random) -> None:
    """Kill one of the processes that a command has started, if there is one."""
    workers = [int(number) for number in group_of([process]) if int(number) != process.pid]
    if workers:
        with contextlib.suppress(ProcessLookupError):
            os.kill(choice.choice(workers), signal.SIGKILL)


def stamps(units: str, folder: Path) -> dict[str, tuple[int, int]]:
    """Finished units: name -> inode and time of the last change, which differ where a file was made again."""
    found = sorted(folder.glob(units)) if units else []
    return {
        str(file.relative_to(folder)): (file.stat().st_ino, file.stat().st_mtime_ns)
        for file in found
        if file.is_file()
    }


def ended(process: subprocess.Popen[str], faults: list[str]) -> str:
    """What a command said on stderr until its end; a command that hangs is a fault, and is killed."""
    try:
        return process.communicate(timeout=HANGS_S)[1]
    except subprocess.TimeoutExpired:
        faults.append("hangs")
        os.killpg(process.pid, signal.SIGKILL)
        return process.communicate()[1]


def start(*arguments: object) -> subprocess.Popen[str]:
    """A command in a session of its own, which hears Ctrl-C also where this program runs in the background."""
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from psotrack.__main__ import main; main()"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments), "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PSOTRACK_PROGRESS": "none"},
    )


def run(*arguments: object) -> None:
    """Run a command that must succeed."""
    process = start(*arguments)
    _, said = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"{arguments[0]}: {said}")


def group_of(processes: list[subprocess.Popen[str]]) -> list[str]:
    """Processes that commands have started and that still run."""
    groups = ",".join(f"{process.pid}" for process in processes)
    return subprocess.run(["pgrep", "-g", groups], capture_output=True, text=True, check=False).stdout.split()


def partial(folder: Path) -> list[Path]:
    """Files that are being written, or that were left."""
    return [
        Path(place, name)
        for place, folders, files in os.walk(folder)
        for name in (*folders, *files)
        if ".partial" in name
    ]


def digests(outputs: tuple[str, ...], folder: Path) -> dict[str, str]:
    """A digest of each file of the results."""
    paths = [folder / name for name in outputs]
    files = [file for path in paths for file in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return {
        str(file.relative_to(folder)): hashlib.sha256(content_of(file)).hexdigest()
        for file in files
        # Compiled programs are a cache of JAX's, not results.
        if file.is_file() and not file.name.startswith(".") and "compiled" not in file.parts
    }


def content_of(path: Path) -> bytes:
    """What must be the same in every run."""
    if path.suffix == ".parquet":
        import pandas as pd

        table = pd.read_parquet(path)
        kept = [
            name
            for name in table
            if not any(word in name for word in ("seconds", "_ms", "real_time", "device"))
        ]
        return table[kept].to_csv(index=False).encode()
    if path.suffix == ".json":
        return json.dumps(without(json.loads(path.read_text(encoding="utf-8"))), sort_keys=True).encode()
    return path.read_bytes()


def without(value: object) -> object:
    """A record without what belongs to the run."""
    if isinstance(value, dict):
        return {key: without(each) for key, each in value.items() if key not in OF_THE_RUN}
    return [without(each) for each in value] if isinstance(value, list) else value


def read(path: Path) -> dict[int, dict[str, object]]:
    """Outcomes of earlier calls."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        return {int(row["number"]): dict(row) for row in csv.DictReader(file)}


def show(outcomes: list[dict[str, object]], seed: int) -> None:
    """Print kills, kept units, failures and the slowest end per command and signal."""
    print(
        f"{'command':<12} {'signal':<8} {'kills':>6} {'writing':>8} {'kept units':>11} {'failures':>9} "
        f"{'slowest end (s)':>16}"
    )
    for command, name in sorted({(str(each["command"]), str(each["signal"])) for each in outcomes}):
        those = [each for each in outcomes if (each["command"], each["signal"]) == (command, name)]
        slowest = max(float(str(each["seconds_to_end"])) for each in those)
        failures = sum(bool(each["failure"]) for each in those)
        writing = sum(each["phase"] == "writing" for each in those)
        kept = sum(int(str(each["kept"])) for each in those)
        print(
            f"{command:<12} {name:<8} {len(those):>6} {writing:>8} {kept:>11} {failures:>9} {slowest:>16.2f}"
        )
    failed = [each for each in outcomes if each["failure"]]
    for each in failed:
        print(f"kill {each['number']}, {each['command']}, {each['signal']}: {each['failure']}")
    print(f"{len(outcomes)} kills, {len(failed)} failures, seed {seed}")
    raise SystemExit(bool(failed))


if __name__ == "__main__":
    main()
