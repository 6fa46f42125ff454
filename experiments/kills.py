"""Kill commands at random moments, run them again, and compare the results with those of runs that were left alone.

    python experiments/kills.py --count 300 --out build/kills --seed 0

Each kill starts a command on a small recording, waits for a random part of the command's usual time, or for a file
that is being written, and sends SIGKILL, SIGTERM or SIGINT. Two sweeps in one folder are both killed, or one of them.
Then the command runs to its end. A kill fails if

- the results are other bytes than undisturbed (seconds, rates and versions of records are left out),
- a unit that was finished (a video, silhouettes of a camera, a cell of a sweep) is made once more,
- a temporary file or a process is left, or the next run needs a hand,
- SIGTERM or SIGINT do not end the command with one line, exit code 143 or 130, within a limit.
"""

from __future__ import annotations

import argparse
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

#: Time to the end that is counted as a failure, seconds; longer on a machine with more work than processors.
LONGEST_S = 2.0
#: Exit codes of signals that a command answers, and the first word of its line.
CODES = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
#: Time after which a command counts as hanging, seconds.
HANGS_S = 300.0
#: Keys of records, and parts of the names of columns, whose values are those of the run, not of the result.
OF_THE_RUN = {
    "seconds",
    "real_time_factor",
    "real_time_factor_running",
    "versions",
    "device",
    "created",
    "started",
}
OF_THE_RUN |= {"command", "machine"}
COLUMNS_OF_THE_RUN = ("seconds", "_ms", "real_time", "device")


@dataclass(frozen=True)
class Command:
    """A command that is killed.

    Attributes:
        words: words of the command; `{given}` is the folder of the input, `{out}` the folder of the output.
        outputs: results in the folder of the output, files or folders.
        units: pattern of the files in the folder of the output that a second run keeps; "" where the second run makes
            all files anew.
        processes: number of the same commands that run at once, on one output.
    """

    words: str
    outputs: tuple[str, ...]
    units: str = ""
    processes: int = 1

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
    "cluster": replace(SWEEP, words=f"{SWEEP.words} --cluster local --workers 2"),
    "labels": Command(
        f"simulate labels {FLIGHT} {{given}}/Simulated_Data/S01_D2_A --out {{out}}/labels "
        "--drone-size 0.3,0.3,0.15 --force",
        ("labels",),
    ),
    "localise": Command(
        "onboard localise {given}/Simulated_Data/S01_D2_A --drone dron1 --out {out}/poses.csv --force",
        ("poses.csv",),
    ),
    "export": Command(f"export {{given}}/tracks.csv {FLIGHT} --to mot --out {{out}}/mot --force", ("mot",)),
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
    """Kill, and print what each kill found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="number of kills in all")
    parser.add_argument("--out", type=Path, default=Path("build/kills"), help="folder of inputs and outputs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", default=",".join(COMMANDS), help="names of commands")
    options = parser.parse_args()
    names, failures = options.commands.split(","), 0
    # Results may contain their paths, so all runs write to one place.
    given, place = options.out.resolve() / "given", options.out.resolve() / "place"
    if not (given / "finished").exists():
        prepare(given)
    expected: dict[str, tuple[float, dict[str, str]]] = {}
    for number in range(options.count):
        choice, name = random.Random(f"{options.seed} {number}"), names[number % len(names)]
        if name not in expected:
            expected[name] = undisturbed(COMMANDS[name], given, place)
        what, faults = kill(COMMANDS[name], choice, given, place, *expected[name])
        failures += bool(faults)
        found = "; ".join(faults) or "as undisturbed"
        print(f"{number + 1} of {options.count}: {name}, {what}: {found}", flush=True)
    print(f"{options.count} kills, {failures} failures, seed {options.seed}")
    raise SystemExit(bool(failures))


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


def kill(
    command: Command,
    choice: random.Random,
    given: Path,
    folder: Path,
    usual_s: float,
    expected: dict[str, str],
) -> tuple[str, list[str]]:
    """Kill a command once, run the command again, and say what was done and what is wrong."""
    # Compiling takes longer than all other work; one kill in five meets a compiler.
    make_place(folder, given, with_programs=choice.random() < 0.8)
    number = choice.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
    moment_s, until_writing = choice.uniform(0, usual_s), choice.random() < 0.5
    processes = [command.start(given, folder) for _ in range(command.processes)]
    killed = processes[: choice.randint(1, command.processes)]
    # Until its first lines run, Python answers signals in its own way.
    while not all(map(answers, processes)):
        time.sleep(0.002)
    began_s = time.monotonic()
    while killed[0].poll() is None and (
        time.monotonic() - began_s < moment_s or (until_writing and not partial(folder))
    ):
        time.sleep(0.002)
    is_over, faults, sent_s = killed[0].poll() is not None, [], time.monotonic()
    for process in killed:
        process.send_signal(number)
    said = [ended(process, faults) for process in killed]
    took_s = time.monotonic() - sent_s
    if number in CODES and not is_over:
        code, word = CODES[number]
        for process, line in zip(killed, said, strict=True):
            # A command may have just finished when the signal came.
            right = process.returncode == 0 and not line
            right |= process.returncode == code and line.startswith(f"psotrack: {word}; ")
            if not right or line.count("\n") > 1:
                faults.append(f"code {process.returncode}: {line[-200:]!r}")
        if took_s > LONGEST_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)):
            faults.append(f"{took_s:.1f} s to the end")
    for process in processes[len(killed) :]:
        if (other := ended(process, faults)) and process.returncode != 0:
            faults.append(f"the other: code {process.returncode}: {other[-200:]!r}")
    if number != signal.SIGKILL and (left := partial(folder)):
        faults.append(f"left {left[0].name}")
    before = stamps(command.units, folder)
    again = command.start(given, folder)
    line = ended(again, faults)
    # What had just finished is not made again.
    had_finished = any(process.returncode == 0 for process in killed)
    if again.returncode != 0 and not (had_finished and "--force" in line):
        faults.append(f"again: code {again.returncode}: {line[-200:]!r}")
    after = stamps(command.units, folder)
    faults += [f"made once more: {name}" for name, stamp in before.items() if after.get(name) != stamp]
    if different := dict(set(digests(command.outputs, folder).items()) ^ set(expected.items())):
        faults.append(f"other results: {min(different)}")
    faults += [f"left after all {path.name}" for path in partial(folder)]
    end_s = time.monotonic() + 10
    while (alive := group_of([*processes, again])) and time.monotonic() < end_s:
        time.sleep(0.1)
    faults += [f"{len(alive)} processes left"] if alive else []
    return f"{number.name} to {len(killed)} after {moment_s:.1f} s, {len(before)} units kept", faults


def answers(process: subprocess.Popen[str]) -> bool:
    """Whether a command answers SIGTERM itself, or has ended."""
    if process.poll() is not None:
        return True
    lines = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii").splitlines()
    (caught,) = (int(line.split()[1], 16) for line in lines if line.startswith("SigCgt:"))
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def stamps(units: str, folder: Path) -> dict[str, int]:
    """Finished units: name -> inode, which differs where a file was made again."""
    found = sorted(folder.glob(units)) if units else []
    return {str(file.relative_to(folder)): file.stat().st_ino for file in found if file.is_file()}


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
        kept = [name for name in table if not any(word in name for word in COLUMNS_OF_THE_RUN)]
        return table[kept].to_csv(index=False).encode()
    if path.suffix == ".json":
        return json.dumps(without(json.loads(path.read_text(encoding="utf-8"))), sort_keys=True).encode()
    return path.read_bytes()


def without(value: object) -> object:
    """A record without what belongs to the run."""
    if isinstance(value, dict):
        return {key: without(each) for key, each in value.items() if key not in OF_THE_RUN}
    return [without(each) for each in value] if isinstance(value, list) else value


if __name__ == "__main__":
    main()
