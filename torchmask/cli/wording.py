"""Errors of the library in the words of the command line: they name options in place of parameters."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_START = r"(?:^|(?<=: ))"  # of a message, or of its part after the name of a file
_VALUE = re.compile(_START + r"(?P<name>[\w.]+) (?:is|are) (?P<value>[-+]?(?:\d[-+\w.]*|nan|inf)|[(\[][^)\]]*)")
_SUBJECT = re.compile(_START + r"(?P<name>[a-z]\w*) (?=(?:is|are|has|have|holds|names|leaves) )")
_ADVICE = re.compile(
    r"(?<=give )(?P<names>[a-z]\w*(?:(?:, or|, and|,| or| and) [a-z]\w*)*)\b"
    r"|(?<![-\w./'\"`])(?P<word>[a-z]\w*_\w+)\b(?![./(=])"
)
_RULE = re.compile(  # a constraint as it prints itself, as advice calls a length of it, and by its name alone
    r"(?P<kind>KeepOutSegment|KeepOutDisc|MinimumGap|RimMargin)"
    r"(?:\((?P<numbers>(?:[^()]|\([^()]*\))*)\)| (?P<length>gap|margin|width|diameter)\b|\b)"
)
_FLAGS = {
    "KeepOutDisc": "--keep-out",
    "KeepOutSegment": "--spiders",
    "MinimumGap": "--min-gap",
    "RimMargin": "--rim-margin",
}
_ANGLE = re.compile(r"[\d.e+-]+ rad \((?P<arcsec>[\d.e+-]+ arcsec)\)")  # options are in arcsec
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)\b")


@dataclass(frozen=True)
class Option:
    """One option of a program, as it was given.

    flag : how it is written, such as --imaging.n-photons
    name : last part of its name as a parameter, such as n_photons
    numbers : the numbers in its value
    is_given : whether the value differs from the default
    is_switch : whether it is on or off
    """

    flag: str
    name: str
    numbers: list[float]
    is_given: bool
    is_switch: bool


def in_options(message: str, options: Any) -> str:
    """Return an error message of the library that speaks of options where it spoke of parameters.

    The library names parameters: "fill_factor is 2.0: it must be ...". Several options may stand behind one parameter,
    and their names may differ from it, so the option is known by its value. In advice, such as "lower fill_factor", the
    name alone decides.

    Parameters
    ----------
    message : str
        Message of a ValueError.
    options : dataclass
        Options of the program, whose fields may be dataclasses of options themselves.

    Examples
    --------
    >>> @dataclass
    ... class Options:
    ...     fill_factor: float = 0.15
    ...     pixel_fill: float | None = None
    >>> in_options("fill_factor is 2.0: it must be a fraction", Options(pixel_fill=2.0))
    '--pixel-fill is 2.0: it must be a fraction'
    >>> in_options("these holes overlap: lower fill_factor", Options())
    'these holes overlap: lower --fill-factor'
    >>> in_options("no mask obeys MinimumGap(gap=0.1)", Options())
    'no mask obeys --min-gap 0.1'
    >>> in_options("pixel_scale 4.848e-06 rad (1 arcsec) undersamples an aperture", Options())
    'pixel_scale 1 arcsec undersamples an aperture'
    """
    known, message = list(_flatten(options)), _ANGLE.sub(r"\g<arcsec>", message)
    message = _RULE.sub(lambda found: _rule(found, known), message)
    told = _VALUE.search(message)
    head = told or _SUBJECT.search(message)
    if head is None:
        return _advise(message, known)
    name, rest = head["name"], message[head.end("name") :]
    valued = [option for option in known if not option.is_switch]  # a switch cannot be wrong
    numbers = [] if told is None else _numbers(told["value"])  # none of a list that is empty
    flag = _by_value(name, numbers, known) if numbers else _by_name(name, valued)
    return message[: head.start()] + (flag or name) + _advise(rest, known)


def _by_value(name: str, numbers: list[float], known: list[Option]) -> str | None:
    """Return the option of a parameter with these numbers: one of its name, or else the only one given with them.

    One of its name without a number may have been filled in: it comes before one with the number among others.
    """
    same = [option for option in known if numbers and _holds(option.numbers, numbers)]
    called = [option for option in known if name in (option.name, option.flag[2:].replace("-", "_"))]
    called = called or [option for option in known if option.name == name.rpartition(".")[2]]
    named = [option for option in called if option in same]
    given = [option for option in same if option.is_given]
    alone = [option for option in given if option.numbers == numbers]
    unset = [option for option in called if not option.numbers and not alone]
    for chosen in (named, unset, given, [option for option in given if name in option.name]):
        if len(chosen) == 1:
            return chosen[0].flag
    return None


def _by_name(name: str, known: list[Option]) -> str | None:
    flags = [option.flag for option in known if option.name in (name, f"{name}_arcsec")]
    return flags[0] if len(flags) == 1 else None


def _advise(text: str, known: list[Option]) -> str:
    """Replace names of parameters that are also those of options."""

    def flags(found: re.Match[str]) -> str:
        return re.sub(r"\w+", lambda word: _by_name(word[0], known) or word[0], found[0])

    return _ADVICE.sub(flags, text)


def _rule(found: re.Match[str], known: list[Option]) -> str:
    """Return a constraint as the options that make it, with its numbers in their order."""
    kind, numbers, length = found["kind"], _NUMBER.findall(found["numbers"] or ""), found["length"]
    if not (numbers or length):
        return _FLAGS[kind]
    if kind == "KeepOutDisc":  # the central obstruction, or one of the discs
        given = [option for option in known if option.name in ("central_obstruction", "keep_out") and option.is_given]
        if numbers:
            diameter, *center = numbers
            alone = [option.flag for option in given if option.numbers == [float(diameter)]]
            central = alone and not any(map(float, center))
            return f"{alone[0]} {diameter}" if central else f"--keep-out {' '.join([*center, diameter])}"
        flags = [option.flag + " diameter" * (option.name == "keep_out") for option in given]
        return " or ".join(flags) or found[0]
    if numbers:
        return f"{_FLAGS[kind]} {' '.join(numbers)}"
    return _FLAGS[kind] + " width" * (length == "width")


def _flatten(options: Any, prefix: str = "--") -> Iterator[Option]:
    """Yield all options but positional arguments, which have no name on the command line."""
    import tyro

    hints = typing.get_type_hints(type(options), include_extras=True)
    for item in dataclasses.fields(options):
        value, flag = getattr(options, item.name), prefix + item.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _flatten(value, f"{flag}.")
        elif tyro.conf.Positional not in typing.get_args(hints[item.name]):
            numbers = [] if isinstance(value, (bool, Path)) else _numbers(str(value))  # those in a path are names
            yield Option(flag, item.name, numbers, value != item.default, isinstance(value, bool))


def _numbers(text: str) -> list[float]:
    return [float(number) for number in _NUMBER.findall(text)]


def _holds(numbers: list[float], wanted: list[float]) -> bool:
    """Return whether these are the wanted numbers, or the one that is wanted is among them."""

    def same(a: float, b: float) -> bool:
        return a == b or (math.isnan(a) and math.isnan(b))

    if len(wanted) == 1:
        return any(same(number, wanted[0]) for number in numbers)
    return len(numbers) == len(wanted) and all(map(same, numbers, wanted))
