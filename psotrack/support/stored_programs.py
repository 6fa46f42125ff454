"""Compiled programs that a later process loads without tracing: a store on disk beside JAX's own compile cache.

JAX's cache saves the compiler's work alone: each process traces and lowers a function before JAX looks the program up,
which takes longer than to load the program. In this store a program is found by what it is made of: the source of this
package, the versions of Python, JAX and jaxlib, the settings of JAX and XLA, the device, the processor, the function,
its static arguments, and the structure, shapes and types of its other arguments.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import hashlib
import inspect
import logging
import os
import pickle
import platform
import threading
import time
import zlib
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jaxlib import lapack

from psotrack.errors import OutputError
from psotrack.support.files import atomic_write
from psotrack.support.program_seals import seal_program, unseal_program

logger = logging.getLogger(__name__)

_R = TypeVar("_R")

_PACKAGE = __name__.split(".", maxsplit=1)[0]
#: Variables that change programs, by the beginnings of their names; JAX's own variables become settings of JAX.
_VARIABLES = ("XLA_", "PJRT_", "TF_XLA_")
#: Settings of JAX that do not change programs, by parts of their names.
_IDLE_SETTINGS = ("cache", "log", "no_tracing")
#: Beginnings of the lines that name the processor and its features, on x86 and ARM.
_CPU_INFO, _CPU_LINES = Path("/proc/cpuinfo"), ("model name", "flags", "Features", "CPU part")

#: A program that no process has used for this time is removed when another one is stored: nothing loads the programs
#: of an older source again. Seconds.
_KEPT_S = 30 * 24 * 3600
#: Largest number of programs that are loaded ahead: a run of one recording uses fewer.
_MOST_AHEAD = 10

#: The programs in memory, by function, static arguments, types and device.
_in_memory: dict[Hashable, Callable[..., Any]] = {}
#: The folder of the stored programs; empty where programs are not stored.
_folders: list[Path] = []
#: The programs that a thread loads ahead, by file and device.
_ahead: dict[tuple[Path, jax.Device], Future[Callable[..., Any] | None]] = {}
#: Held while a program is compiled for the store: JAX's cache is switched off for the whole process meanwhile.
_compiling = threading.Lock()


def store_programs(folder: Path | str) -> None:
    """Store the programs of all functions with `stored_jit` in a folder, and load programs that are there."""
    _folders[:] = [Path(folder)]


def forget_programs() -> None:
    """Drop the programs that were loaded or stored from memory; those that are used again are loaded again."""
    _in_memory.clear()
    _ahead.clear()


def load_ahead() -> None:
    """Let a thread load the programs that were used last: most runs use the same programs as the run before.

    For the time in which other processes do the work. It does nothing where programs are not stored.
    """
    device = _processor_of([]) if _folders else None
    if device is None:
        return
    dated = []
    for path in _folders[0].glob("*.program"):
        with contextlib.suppress(OSError):  # another process may replace the file
            dated.append((path.stat().st_mtime, path))
    thread = ThreadPoolExecutor(1)
    # In the order in which the last run used them.
    for _, path in sorted(dated)[-_MOST_AHEAD:]:
        _ahead[path, device] = thread.submit(_load, path, device)
    thread.shutdown(wait=False)


class stored_jit(Generic[_R]):  # noqa: N801  a decorator
    """`jax.jit`, but a program that an earlier process has stored is loaded without tracing the function.

    Without a folder (`store_programs`), this is `jax.jit`. It is also `jax.jit` inside of another compiled function,
    on an accelerator, for arguments on several devices, and where a class from outside of this package is part of the
    program, such as a plug-in's score: the store does not know its source.

    Args:
        function: a function of this package, without callbacks into Python.
        static_argnames: name of the static argument, or names.
    """

    def __init__(self, function: Callable[..., _R], *, static_argnames: str | tuple[str, ...] = ()) -> None:
        self._jitted = jax.jit(function, static_argnames=static_argnames)
        self._static = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
        self._signature = inspect.signature(function)
        self._name = f"{function.__module__}.{function.__qualname__}"
        functools.update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> _R:
        """Call the compiled function."""
        if not _folders:
            return self._jitted(*args, **kwargs)
        arguments = self._signature.bind(*args, **kwargs).arguments
        static = {name: arguments.pop(name) for name in self._static if name in arguments}
        leaves, structure = jax.tree.flatten(arguments)
        device = _processor_of(leaves)
        if device is None:
            return self._jitted(*args, **kwargs)
        types = tuple((jax.typeof(leaf), _is_committed(leaf)) for leaf in leaves)
        key = self, *static.items(), structure, types, device
        program = _in_memory.get(key)
        if program is None:
            try:
                parts = [self._name, *map(_described, (static, structure)), *map(str, types)]
                path = _folders[0] / f"{self._name}-{_digest([*parts, *_surroundings(device)])}.program"
            except _ForeignError as error:
                logger.debug("%s is not stored: %s is not part of psotrack", self._name, error)
                program = functools.partial(self._jitted, **static)
            else:
                program = _loaded(path, device) or _make(path, self._jitted, static, arguments)
            _in_memory[key] = program
        result: _R = program(**arguments)
        return result

    def __getattr__(self, name: str) -> Any:
        """Everything else is as of `jax.jit`, such as `lower`."""
        return getattr(self._jitted, name)


def _loaded(path: Path, device: jax.Device) -> Callable[..., Any] | None:
    """A stored program, loaded now or ahead; None where it is not stored or cannot be used."""
    loading = _ahead.pop((path, device), None)
    program = _load(path, device) if loading is None or loading.cancel() else loading.result()
    if program is not None:
        with contextlib.suppress(OSError):  # a folder that cannot be written
            path.touch()
    return program


def _load(path: Path, device: jax.Device) -> Callable[..., Any] | None:
    """A stored program; None where it is not stored or cannot be used."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        logger.warning("%s: %s; the program is compiled again", path, error.strerror or error)
        return None
    content = unseal_program(data)
    if content is None:
        logger.warning("%s is damaged or no program of psotrack; the program is compiled again", path)
        return None
    # JAX loads LAPACK when it lowers a function; a program that calls it earlier ends the process.
    lapack.prepare_lapack_call("potrf_ffi", np.float32)
    try:
        executable, taken, returned = pickle.loads(zlib.decompress(content))
        program = serialize_executable.deserialize_and_load(
            executable, taken, returned, execution_devices=[device]
        )
    except (ValueError, RuntimeError) as error:
        logger.warning("%s: %s; the program is compiled again", path, f"{error}".partition("\n")[0])
        return None
    logger.info("loaded the compiled program %s", path.name)
    return program


def _make(path: Path, jitted: Any, static: dict[str, Any], arguments: dict[str, Any]) -> Callable[..., Any]:
    """A program that is compiled and stored."""
    # A program that JAX took from its own cache loses functions when it is stored (seen with JAX 0.10 on a CPU).
    with _without_cache_of_jax():
        compiled: jax.stages.Compiled = jitted.lower(**static, **arguments).compile()
    content = zlib.compress(pickle.dumps(serialize_executable.serialize(compiled)), level=1)
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(seal_program(content))
    except OutputError as error:
        logger.info("%s", error)
    else:
        logger.info("stored the compiled program %s", path.name)
        _remove_unused(path.parent)
    return compiled


def _remove_unused(folder: Path) -> None:
    """Remove the programs that were not used for a long time."""
    oldest_s = time.time() - _KEPT_S
    for path in folder.glob("*.program"):
        with contextlib.suppress(OSError):  # another process may remove or replace the file
            if path.stat().st_mtime < oldest_s:
                path.unlink()
                logger.info("removed the compiled program %s, which was not used for a long time", path.name)


@contextlib.contextmanager
def _without_cache_of_jax() -> Iterator[None]:
    setting = "jax_enable_compilation_cache"
    with _compiling:
        before = jax.config.values[setting]
        try:
            jax.config.update(setting, False)
            # JAX decides once whether it uses its cache; this makes it decide again.
            compilation_cache.reset_cache()
            yield
        finally:
            jax.config.update(setting, before)
            compilation_cache.reset_cache()


def _is_committed(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and leaf.committed


def _processor_of(leaves: list[Any]) -> jax.Device | None:
    """The processor on which JAX would compute; None where it would not compute now, or not on one processor."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return None
    devices = set().union(*(leaf.devices() for leaf in leaves if _is_committed(leaf)))
    if not devices:
        default = jax.config.jax_default_device  # type: ignore[attr-defined]
        devices = {jax.devices()[0] if default is None else default}
    (device, *others) = devices
    # The default device may be a name.
    return device if not others and isinstance(device, jax.Device) and device.platform == "cpu" else None


class _ForeignError(Exception):
    """A class is not of this package."""


def _described(value: Any) -> str:
    """A text that is the same for equal values in all processes.

    Raises:
        _ForeignError: the value contains one of a class that is neither simple nor of this package.
    """
    if isinstance(value, enum.Enum) or value is None:
        return repr(value)
    if isinstance(value, str | bytes | bool | int | float):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_described, value))})"
    if isinstance(value, dict):
        return f"({', '.join(f'{name}: {_described(part)}' for name, part in sorted(value.items()))})"
    if isinstance(value, jax.tree_util.PyTreeDef):
        node = value.node_data()
        return "leaf" if node is None else _described([_named(node[0]), node[1], value.children()])
    if is_dataclass(value):
        parts = {each.name: getattr(value, each.name) for each in fields(value)}
        return f"{_named(type(value))} {_described(parts)}"
    raise _ForeignError(_named(type(value)))


def _named(kind: type) -> str:
    """Full name of a class."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    if kind.__module__.split(".")[0] not in {"builtins", _PACKAGE}:
        raise _ForeignError(name)
    return name


def _surroundings(device: jax.Device) -> list[str]:
    """What every program depends on, besides its function and arguments."""
    settings = {
        name: str(getattr(jax.config, name, value))
        for name, value in sorted(jax.config.values.items())
        if not any(part in name for part in _IDLE_SETTINGS)
    }
    variables = {name: value for name, value in sorted(os.environ.items()) if name.startswith(_VARIABLES)}
    client = device.client
    of_device = device.platform, device.device_kind, device.id, client.platform_version, client.device_count()
    versions = version("jax"), version("jaxlib"), platform.python_version()
    return [_digest_of_source(), repr((settings, variables, of_device, versions)), _processor()]


@functools.cache
def _digest_of_source() -> str:
    """Digest of the files of this package; its version stands in a file."""
    folder = Path(__file__).parents[1]
    return _digest(
        [f"{path.relative_to(folder)} {path.read_text('utf-8')}" for path in sorted(folder.rglob("*.py"))]
    )


@functools.cache
def _processor() -> str:
    """The processor, its features, and the number of processors that XLA divides work among."""
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8").split("\n\n", maxsplit=1)[0].splitlines()
    except OSError:
        lines = [platform.processor()]
    else:
        lines = [line for line in lines if line.startswith(_CPU_LINES)]
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return repr((platform.system(), platform.machine(), count, lines))


def _digest(texts: list[str]) -> str:
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=20).hexdigest()
