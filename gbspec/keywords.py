"""The keyword arguments of the Python interface: typed options, and an answer to a misspelt name.

`TrainKeywords` and the others list, for type checkers and editors, the fields of the dataclasses that hold the options
(a test compares them); `options_of` adds these to the signature and the help of a function at run time. `near_names`
and `with_near_names` give a function, or the methods of a class, the answer that `options_of` gives: the nearest name.
"""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Any, Literal, TypedDict, TypeVar, cast

from gbspec.data import Box
from gbspec.training import Effort

Function = TypeVar("Function", bound=Callable[..., object])
Class = TypeVar("Class")


class TrainKeywords(TypedDict, total=False):
    """The fields of `TrainOptions`, whose help `help(gbspec.train)` shows."""

    members: int
    seed: int
    max_step: float | None
    solver: str
    tolerance: float | None
    switches: Literal["auto", "on", "off"]
    method: Literal["auto", "gradient-matching", "adam", "lbfgs", "lm"]
    stages: str | None
    effort: Effort
    start: str | None
    epochs: int | None
    quadrature: int | None
    holdout: float
    workers: int | None
    device: Literal["cpu", "cuda", "auto"]
    backend: Literal["auto", "native", "torch"]
    scheduler: str | None
    resume: bool
    forcing: str
    initial: Literal["learned", "bred", "recognition"]
    random_substeps: bool
    batch_size: int
    learning_rate: float
    warm_start: bool
    output_scale: float
    half_step: bool
    ridge: float | None
    threads: int | None


class SimulateKeywords(TypedDict, total=False):
    """The fields of `SimulateOptions`, whose help `help(gbspec.simulate)` shows."""

    trajectories: int
    span: float
    dt: float
    sampling: Literal["regular", "gamma"]
    channels: str
    keep_start: bool
    noise: float
    seed: int
    initial: Mapping[str, Box]
    condition: Mapping[str, Box]
    dose: Mapping[str, str]
    clock: Mapping[str, float]
    reject: tuple[str, ...]


class StudyKeywords(TypedDict, total=False):
    """The fields of `StudyOptions`, whose help `help(gbspec.study)` shows."""

    case: tuple[str, ...]
    members: int | None
    seed: int
    effort: Effort | None
    noise: float | None
    workers: int
    threads: int
    keep_runs: bool
    table_only: bool


def options_of(options: type) -> Callable[[Function], Function]:
    """Replaces `**options` of a function by the fields of a dataclass, in its signature and its help."""

    def described(function: Function) -> Function:
        signature = inspect.signature(function)
        before = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        taken = {parameter.name for parameter in before}
        lines = []
        for item in fields(options):
            if item.name in taken:
                continue
            default = item.default if item.default is not MISSING else _made(item.default_factory)
            before.append(
                inspect.Parameter(item.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=item.type)
            )
            lines += [f"    {item.name}: {item.type} = {default!r}", f"        {item.metadata.get('help', '')}"]
        function.__signature__ = signature.replace(parameters=before)  # type: ignore[attr-defined]  # documented by inspect
        function.__doc__ = "\n".join([inspect.cleandoc(function.__doc__ or ""), "", "Options:", *lines])
        return near_names(function)

    return described


def near_names(function: Function) -> Function:
    """The function, whose `TypeError` for an unknown keyword argument names it by its public name and the nearest one.

    Without it Python says neither, and an option would be missed by the name of a class that holds the options.
    """
    signature = inspect.signature(function)
    named = [p for p in signature.parameters.values() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    known = [p.name for p in named if p.name != "self"]

    @functools.wraps(function)
    def answered(*given: object, **keywords: object) -> object:
        for name in keywords:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f"; did you mean `{near[0]}`?" if near else f"; it has {', '.join(known) or 'none'}"
                raise TypeError(f"{function.__name__}() has no option `{name}`{hint}")
        return function(*given, **keywords)

    return cast(Function, answered)


def with_near_names(cls: type[Class]) -> type[Class]:
    """The class, whose public methods are `near_names`."""
    for name, method in vars(cls).copy().items():
        if inspect.isfunction(method) and not name.startswith("_"):
            setattr(cls, name, near_names(method))
    return cls


def _made(factory: Any) -> object:
    return factory() if callable(factory) else inspect.Parameter.empty
