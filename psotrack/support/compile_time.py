"""The time that JAX takes to compile: figures of speed count it apart from the work."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax

#: Beginning of JAX's names of the events of tracing, lowering, compiling, and loading compiled programs.
_COMPILING = "/jax/core/compile/"


@contextlib.contextmanager
def measured_compiling() -> Iterator[Callable[[], float]]:
    """Measure compiling in all threads; yields a function that returns the seconds so far.

    These are seconds of wall clock in which at least one thread compiled. Use it as in
    `with measured_compiling() as compile_s: ...; print(compile_s())`.
    """
    spans: list[tuple[float, float]] = []

    def note(event: str, start_time: float, end_time: float, **_: Any) -> None:
        if event.startswith(_COMPILING):
            spans.append((start_time, end_time))

    jax.monitoring.register_event_time_span_listener(note)
    try:
        yield lambda: _covered_s(spans)
    finally:
        jax.monitoring.unregister_event_time_span_listener(note)


def _covered_s(spans: list[tuple[float, float]]) -> float:
    """Length of the union of spans of time, seconds."""
    covered_s, until_s = 0.0, float("-inf")
    for start_s, end_s in sorted(spans):
        covered_s += max(0.0, end_s - max(start_s, until_s))
        until_s = max(until_s, end_s)
    return covered_s
