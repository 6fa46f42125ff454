"""Calls of the public functions, checked before they run: a wrong one is answered like a wrong option.

Python itself answers a forgotten argument with a TypeError, and a wrong object with an AttributeError from the middle
of the package. Here the message names the function, the argument, what was expected and what was found.
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
import numbers
import re
import types
import typing
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import AbstractArray, Shaped

from psotrack.errors import SettingsError
from psotrack.support.schema import bind
from psotrack.support.text_tables import short_text

_Called = TypeVar("_Called", bound=Callable[..., Any])

#: Words for annotations, for messages.
_WORDS: dict[Any, str] = {
    str: "text", int: "a whole number", float: "a number", bool: "True or False", Path: "a path",
    types.NoneType: "None", collections.abc.Callable: "a function", collections.abc.Mapping: "a mapping",
    collections.abc.Sequence: "a sequence", dict: "a dict", tuple: "a tuple", list: "a list",
}  # fmt: skip
#: What is as good as an object of a class.
_AS_GOOD: dict[Any, tuple[type, ...]] = {
    float: (numbers.Real, np.number),
    int: (numbers.Integral,),
    bool: (np.bool_,),
    tuple: (list, np.ndarray),
    list: (tuple, np.ndarray),
    collections.abc.Sequence: (np.ndarray,),
}


def check_records(kind: type) -> None:
    """Let a dataclass refuse wrong arguments with a `SettingsError`.

    The shapes of arrays are left to a class that checks its fields; the fields of others are compared with nothing,
    because JAX puts what it likes into them.
    """
    if "_is_checked" in vars(kind):
        return
    kind._is_checked = True  # type: ignore[attr-defined]
    make: Any = kind.__init__  # type: ignore[misc]
    name, signature = f"{kind.__name__}()", inspect.signature(kind)
    annotations = typing.get_type_hints(kind) if hasattr(kind, "__post_init__") else {}

    @functools.wraps(make)
    def checking(self: Any, *args: Any, **kwargs: Any) -> None:
        _check(name, bind(name, signature, args, kwargs).arguments, annotations, shapes=False)
        make(self, *args, **kwargs)

    kind.__init__ = checking  # type: ignore[misc]


def checked(function: _Called) -> _Called:
    """The function, which refuses wrong arguments with a `SettingsError`.

    Arguments are compared with the annotations: classes, unions, literals, and the shapes of arrays. What is in a
    sequence or a mapping is left to the function.
    """
    name = f"{function.__name__}()"
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        _check(name, bind(name, signature, args, kwargs).arguments, _annotations(function), shapes=True)
        return function(*args, **kwargs)

    return typing.cast(_Called, call)


@functools.cache
def _annotations(function: Callable[..., Any]) -> dict[str, Any]:
    """Annotations of the arguments; that of the result may name what only a checker of types imports."""
    original: Any = inspect.unwrap(function)
    named = {name: each for name, each in original.__annotations__.items() if name != "return"}
    return typing.get_type_hints(types.SimpleNamespace(__annotations__=named), original.__globals__)


def _check(name: str, values: Mapping[str, Any], annotations: Mapping[str, Any], *, shapes: bool) -> None:
    for argument, value in values.items():
        # The annotation of `**more` is that of each value in a dict.
        if argument in annotations and argument not in ("more", "parts"):
            annotation = annotations[argument]
            if not _fits(value, annotation, shapes):
                raise SettingsError(
                    f"{name}, {argument}", expected=_expected(annotation), found=short_text(value)
                )


def _fits(value: Any, annotation: Any, shapes: bool) -> bool:
    """Whether a value may be given where an annotation stands; where that is hard to say, it may."""
    kinds = typing.get_args(annotation)
    origin = typing.get_origin(annotation) or annotation
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, kind, shapes) for kind in kinds)
    if origin is typing.Literal:
        return value in kinds
    if origin is typing.Annotated:
        return _fits(value, kinds[0], shapes)
    if origin in (None, types.NoneType):
        return value is None
    if not isinstance(origin, type) or origin is object:
        return True
    if issubclass(origin, AbstractArray):
        if not shapes or not hasattr(value, "shape"):
            return hasattr(value, "shape")
        return isinstance(value, _shaped(typing.cast(Hashable, type(value)), origin.dim_str))
    if origin is collections.abc.Sequence and isinstance(value, str | bytes):
        # A text where several are expected would be taken for its letters.
        return False
    return isinstance(value, (origin, *_AS_GOOD.get(origin, ())))


@functools.cache
def _shaped(kind: Hashable, shape: str) -> Any:
    """The annotation of arrays of a kind and a shape; to make it takes longer than to check it."""
    return Shaped[kind, shape]


def _expected(annotation: Any) -> str:
    """Words for what an annotation takes."""
    kinds = typing.get_args(annotation)
    origin = typing.get_origin(annotation) or annotation
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_expected, kinds)))
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, kinds))}"
    if origin is typing.Annotated:
        return _expected(kinds[0])
    if isinstance(origin, type) and issubclass(origin, AbstractArray):
        return f"an array ({re.sub(r'[*#]+[a-z]*', '...', origin.dim_str).replace(' ', ', ')})"
    return _WORDS.get(origin, f"a {getattr(origin, '__name__', origin)}")
