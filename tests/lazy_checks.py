"""Checks of types and shapes that cost little where a function is called often, or never.

jaxtyping and beartype write and compile the code of a function's checks, some milliseconds each; the package has
thousands of functions, of which one process of the tests calls a part. A check then costs a tenth of a millisecond,
more than many functions themselves.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial, wraps
from types import FunctionType
from typing import Any

import jaxtyping

#: Number of calls of a function, in each process, that are all checked. Of later calls, one in `ONE_IN` is checked.
ALL_OF, ONE_IN = 200, 20

_jaxtyped = jaxtyping.jaxtyped
_all_calls = False


def install(package: str) -> None:
    """Check the types and shapes of calls of the functions of a package that is not imported yet."""
    # The import hook decorates each function with `jaxtyping.jaxtyped`.
    jaxtyping.jaxtyped = _lazily_jaxtyped
    jaxtyping.install_import_hook(package, "beartype.beartype")


@contextmanager
def all_calls_checked() -> Iterator[None]:
    """Check all calls, also of functions that were called often."""
    global _all_calls
    _all_calls = True
    try:
        yield
    finally:
        _all_calls = False


def _lazily_jaxtyped(function: Any = None, *, typechecker: Any) -> Any:
    """`jaxtyping.jaxtyped`, whose decoration of a function waits for the first call."""
    if function is None:
        return partial(_lazily_jaxtyped, typechecker=typechecker)
    if not isinstance(function, FunctionType):
        return _jaxtyped(function, typechecker=typechecker)
    return _checked(function, typechecker)


def _checked(function: FunctionType, typechecker: Any) -> Callable[..., Any]:
    checked, calls = None, 0

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        nonlocal checked, calls
        calls += 1
        if calls > ALL_OF and calls % ONE_IN and not _all_calls:
            return function(*arguments, **named)
        if checked is None:
            checked = _jaxtyped(function, typechecker=typechecker)
        return checked(*arguments, **named)

    return call
