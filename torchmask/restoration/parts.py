"""What settings, functions and networks are made of, by which they are known and what they hold is found."""

from __future__ import annotations

import dis
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from types import CellType, CodeType, FunctionType, MethodType
from typing import Any

import numpy as np
from torch import nn
from torch.fx import GraphModule
from torch.jit import ScriptModule

# of what every module has: the rest are hooks
_TOLD = {"training", "_parameters", "_buffers", "_modules"}
_UNTOLD = vars(nn.Module()).keys() - _TOLD | {"_compiled_call_impl"}  # the last is what `Module.compile` has made


def everything_in(value: object, seen: dict[int, object] | None = None) -> Iterator[object]:
    """Yield the value, its parts, their parts and so on; for what has come before (`seen`), a word of its number."""
    seen = {} if seen is None else seen
    value = as_written(value)
    if id(value) in seen:
        yield f"as {list(seen).index(id(value))}"
        return
    yield value
    parts = parts_of(value)
    if parts is not None and not isinstance(value, tuple):  # equal tuples may be one object or not
        seen[id(value)] = value  # which lives on, so that nothing else gets its address
    for part in parts or ():
        yield from everything_in(part, seen)


def as_written(value: object) -> object:
    """Return a function or module as it was before `torch.compile`."""
    if isinstance(value, FunctionType):
        return vars(value).get("_torchdynamo_orig_callable", value)
    return getattr(value, "_orig_mod", value) if isinstance(value, nn.Module) else value


def parts_of(value: Any) -> list[Any] | None:
    """Return what tells a value from others of its type, always in the same order; None if it has no parts."""
    if isinstance(value, nn.Module):
        return _parts_of_module(value)
    if isinstance(value, FunctionType):
        return _parts_of_function(value)
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, partial):
        return [value.func, value.args, value.keywords]
    if inspect.isroutine(value):  # one that is built in
        return [value.__name__, getattr(value, "__self__", None), getattr(value, "__objclass__", None)]
    if is_dataclass(value) and not isinstance(value, type):
        return [getattr(value, item.name) for item in fields(value)]
    if isinstance(value, Mapping):
        return [part for key in sorted(value, key=repr) for part in (key, value[key])]
    if isinstance(value, set | frozenset):
        return sorted(value, key=repr)
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return [value.tolist()]
    return list(value) if isinstance(value, tuple | list) else None


def _parts_of_module(module: nn.Module) -> list[Any]:
    if isinstance(module, ScriptModule | GraphModule):
        return [module.code, dict(module.state_dict())]
    return [{name: part for name, part in vars(module).items() if name not in _UNTOLD}]


def _parts_of_function(function: FunctionType) -> list[Any]:
    code, around = function.__code__, function.__globals__
    enclosed = [_content(cell) for cell in function.__closure__ or ()]
    read = {name: _from_outside(function, around[name]) for name in _names(code) if name in around}
    defaults = (function.__defaults__, function.__kwdefaults__)
    return [function.__module__, function.__qualname__, code, *defaults, enclosed, read]


def _content(cell: CellType) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # it is empty yet
        return "empty"


def _names(code: CodeType) -> set[str]:
    """Return the names that a function, and those that it defines, read from their file."""
    names = {str(step.argval) for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    return names.union(*(_names(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _from_outside(function: FunctionType, value: Any) -> Any:
    """Return the name of a function of another file, as what a library holds is no end of things, or the value."""
    is_foreign = isinstance(value, FunctionType) and value.__module__ != function.__module__
    return f"{value.__module__}.{value.__qualname__}" if is_foreign else value
