"""Training: from samples to the network that does best on samples that it has not learned.

After each epoch the state is written beside the model file, and a training that was interrupted goes on from there: its
result has the same bytes as that of one that was left alone.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.foreground.detection import DATA_SET, parts_of
from psotrack.foreground.learning.data_sets import read_data_set
from psotrack.foreground.learning.pictures import draw_findings
from psotrack.foreground.learning.samples import Samples, batches, gather
from psotrack.foreground.learning.scores import score
from psotrack.foreground.learning.settings import TrainSettings
from psotrack.foreground.learning.steps import State, Teacher
from psotrack.foreground.learning.tracked import TrackedDrones
from psotrack.foreground.network import Model, from_bytes, head_of, model_at, to_bytes, write_model
from psotrack.foreground.network.names import MODEL_SUFFIX, NETWORK, model_path
from psotrack.foreground.silhouettes import SilhouetteSettings, num_processes, scaled_settings
from psotrack.recordings.datasets import open_recording
from psotrack.support import Report, atomic_write, digest_file, digest_record, no_progress

logger = logging.getLogger(__name__)

#: Largest number of frames of a camera that validate.
_VALIDATED = 4
#: How the state of an unfinished training is named beside the model file.
_STATE_SUFFIX = ".unfinished"


def train_on_sequences(
    sequences: Sequence[Path],
    out: Path,
    settings: TrainSettings,
    *,
    cache: Path,
    jobs: int | None = None,
    report: Report = no_progress,
    say: Callable[[str], object] = lambda line: None,
) -> Model:
    """Train a network on sequences whose drones are known, and write its file.

    Args:
        sequences: at least two sequences, with masks of their drones or tracks; or folders of YOLO data sets.
        out: the model file.
        settings: settings of the training.
        cache: folder for stored results.
        jobs: largest number of processes that make samples; None: one per processor.
        report: shows the progress.
        say: is told a line after each epoch.

    Raises:
        InputError: a sequence cannot be read, has neither masks nor tracks, or no drones are seen.
        SettingsError: two sequences have the same name, a validation name is unknown, or no sequence is left for
            training or validation.
        OutputError: a file cannot be written.
    """
    found: dict[str, list[Samples]] = {"train": [], "val": []}
    about: dict[str, Any] = {"train": {}, "val": {}}

    def add(name: str, part: str, made: list[Samples]) -> None:
        made = [each.thinned(_VALIDATED) if part == "val" and not each.by_boxes else each for each in made]
        found[part] += made
        content = digest_record([each.key for each in made])
        about[part][name] = {"samples": sum(map(len, made)), "content": content}

    data_sets = [path for path in sequences if (path / DATA_SET).is_file()]
    for path in data_sets:
        of_parts = read_data_set(path, cache=cache, report=report)
        for part, made in zip(("train", "val"), of_parts, strict=True):
            add(path.name, part, made)
    recordings = [open_recording(path).usable() for path in sequences if path not in data_sets]
    names = [recording.name for recording in recordings]
    if recordings and (settings.validation or not data_sets):
        parts = parts_of(names, settings.validation or ())
    else:
        parts = dict.fromkeys(names, "train")  # the data sets validate
    for recording in recordings:
        tracks = recording.folder / "results" / "tracks.csv"
        made = gather(
            recording,
            scaled_settings(SilhouetteSettings(), recording),
            tracked=TrackedDrones.read(tracks) if settings.from_tracks else None,
            per_camera=settings.per_camera,
            cache=cache,
            jobs=num_processes(jobs),
            report=report,
        )
        add(recording.name, parts[recording.name], made)
    return train(found["train"], found["val"], out, settings, about=about, report=report, say=say)


def train(
    training: Sequence[Samples],
    validation: Sequence[Samples],
    out: Path,
    settings: TrainSettings,
    *,
    about: Mapping[str, Any],
    report: Report = no_progress,
    say: Callable[[str], object] = lambda line: None,
) -> Model:
    """Train a network, and write its file.

    Args:
        training, validation: samples, video by video; the validation decides which epoch's network is kept.
        out: the model file. A picture of what the network finds is written beside it after each epoch.
        settings: settings of the training.
        about: what the samples are, for the model's card; together with the settings it decides whether an unfinished
            training goes on.
        report: shows the progress in steps.
        say: is told a line after each epoch.

    Raises:
        InputError: no sample shows a drone, the samples show nothing but one colour, or the network to start from
            cannot be read.
        OutputError: a file cannot be written.
    """
    _check(training, "training")
    _check(validation, "validation")
    steps = settings.epochs * settings.steps
    teacher = Teacher(settings.learning_rate, steps, settings.seed)
    unfinished = out.with_suffix(_STATE_SUFFIX)
    start = None if settings.start is None else _start(settings.start)
    about = {**about, "start": None if start is None else digest_file(start)}
    of = digest_record({"settings": msgspec.to_builtins(settings), "about": about})
    state, history = _resumed(
        unfinished, teacher.begin(None if start is None else model_at(start).network), of
    )
    with report("train", steps) as advance, ThreadPoolExecutor(1) as ahead:
        advance(len(history) * settings.steps)
        while len(history) < settings.epochs and _since_best(history) < settings.patience:
            epoch, learned = len(history), 0.0
            generator = np.random.default_rng([settings.seed, epoch])
            coming = batches(training, settings.part_px, settings.batch, generator)
            made = [ahead.submit(next, coming)]
            for _ in range(settings.steps):
                made.append(ahead.submit(next, coming))
                state, loss = teacher.step(state, made.pop(0).result())
                learned += loss / settings.steps
                advance(1)
            if not math.isfinite(learned):
                expected, remedy = "a loss that is a number", "take a smaller --learning-rate"
                where = f"epoch {epoch + 1}"
                raise SettingsError(where, expected=expected, found=f"{learned}", remedy=remedy)
            found = score(state.network, validation)
            if all(found.loss < each["loss"] for each in history):
                state = state._replace(best=state.network)
            history.append({"learned": learned, **found._asdict()})
            told = ", ".join(f"{name} {value:.3f}" for name, value in history[-1].items())
            say(f"epoch {epoch + 1}: {told}")
            with atomic_write(unfinished) as temporary:
                temporary.write_bytes(to_bytes(state, {"of": of, "history": history}))
            draw_findings(state.network, validation, history, out.with_suffix(".png"))
    model = Model(
        state.best,
        {**about, "settings": msgspec.to_builtins(settings), "epochs": history, **_best(history)},
    )
    write_model(out, model)
    unfinished.unlink(missing_ok=True)
    return model


def _check(samples: Sequence[Samples], part: str) -> None:
    if not any(np.isfinite(each.box_px).any() for each in samples):
        raise InputError(
            f"samples for {part}", expected="frames that show drones", found="no drone in any frame"
        )
    if all(np.ptp(each.image) == 0 for each in samples):
        raise InputError(
            f"samples for {part}", expected="frames that show a scene", found="frames of one colour"
        )


def _start(name: str) -> Path:
    """The file of the network from which a training goes on."""
    path = model_path(name)
    if path is None:
        expected = f"{NETWORK}, or a file of `psotrack train` that ends in {MODEL_SUFFIX}"
        raise SettingsError("start", expected=expected, found=name)
    return path


def _resumed(path: Path, first: State, of: str) -> tuple[State, list[dict[str, float]]]:
    """The state of an unfinished training and its epochs so far, or a first state."""
    if not path.exists():
        return first, []
    content = path.read_bytes()
    head = head_of(content)
    if head.get("of") != of:
        expected, found = "no unfinished training, or one with these samples and settings", "one with others"
        raise OutputError(
            path, expected=expected, found=found, remedy="delete the file, or go on as it was begun"
        )
    logger.info("%s: going on after %d epochs", path, len(head["history"]))
    state: State = from_bytes(content, first)
    return state, head["history"]


def _best(history: list[dict[str, float]]) -> dict[str, Any]:
    best = min(range(len(history)), key=lambda index: history[index]["loss"])
    return {"best_epoch": best + 1, "validation": history[best]}


def _since_best(history: list[dict[str, float]]) -> int:
    return len(history) - _best(history)["best_epoch"] if history else 0
