"""Devices: runs shared among all devices, one thread for each device; and how a device computes its runs."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from psotrack.support import Advance, Report

Job = TypeVar("Job")
Result = TypeVar("Result")

#: Function that does some jobs on one device, and reports the progress.
Work = Callable[[list[Job], jax.Device, Report], list[Result]]


def share_among_devices(
    jobs: Sequence[Job], kinds: Sequence[Hashable], work: Work[Job, Result], report: Report
) -> list[Result]:
    """Do all jobs, and return the results in the order of the jobs.

    While one device computes, the thread of another device can run its Python code. The calling thread works on the
    first share itself, so that it reports the progress and receives an interrupt.

    Args:
        jobs: the jobs.
        kinds: kind of each job: jobs of one kind use the same compiled program, and are spread evenly over the devices.
        work: function that does some of the jobs on one device.
        report: shows the progress of the first device.
    """
    devices = jax.devices()[: len(jobs)]
    by_kind = sorted(range(len(jobs)), key=lambda number: kinds.index(kinds[number]))
    shares = [by_kind[first :: len(devices)] for first in range(len(devices))]
    stopped = threading.Event()

    def work_on(share: list[int], device: jax.Device, report: Report) -> list[Result]:
        with jax.default_device(device):
            return work([jobs[number] for number in share], device, report)

    @contextlib.contextmanager
    def until_stopped(description: str, total: int) -> Iterator[Advance]:
        def advance(steps: int) -> None:
            if stopped.is_set():
                raise RuntimeError("another share of the runs has failed")

        yield advance

    with ThreadPoolExecutor(len(devices)) as threads:
        others = [
            threads.submit(work_on, share, device, until_stopped)
            for share, device in zip(shares[1:], devices[1:], strict=True)
        ]
        try:
            done = [work_on(shares[0], devices[0], report), *[other.result() for other in others]]
        except BaseException:
            stopped.set()
            raise
    results = {
        number: result
        for share, of_share in zip(shares, done, strict=True)
        for number, result in zip(share, of_share, strict=True)
    }
    return [results[number] for number in range(len(jobs))]


def largest_share(kinds: Sequence[Hashable], kind: Hashable) -> int:
    """Largest number of jobs of a kind that `share_among_devices` gives to one device."""
    devices = len(jax.devices()[: len(kinds)])
    return -(-sum(other == kind for other in kinds) // devices)


def num_used_devices(num_jobs: int) -> int:
    """Number of devices that work on `num_jobs` jobs."""
    return len(jax.devices()[:num_jobs])


def computes_side_by_side(platform: str) -> bool:
    """Whether a device computes the runs of a batch side by side: an accelerator does, a CPU does not.

    An accelerator is as fast for many runs as for one until its arithmetic units are busy. A CPU gains nothing, and one
    run after the other has the same bits as alone.

    Args:
        platform: platform of the device: "cpu", "gpu" or another accelerator's.
    """
    return platform != "cpu"
