"""A program of the command line: options in, exit status out. Each `torchmask COMMAND` is one, and each script that
shares its ways.

Exit status: 0 done; 1 something the user can mend, said in one line; 2 wrong usage; 3 done, and all of it written, but
the result does not explain the data; 130 interrupted, by Ctrl-C or by SIGTERM, which batch systems send.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import signal
import sys
import threading
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from torchmask.cli.config import CONFIG, load_config
from torchmask.cli.wording import in_options
from torchmask.instrument.instrument import Instrument

T = TypeVar("T")

NOT_EXPLAINED = 3  # exit status
_LARGEST_SEED = 2**63 - 1  # signed integers of 64 bits, as which generators take seeds
_NO_MEMORY = re.compile("allocate memory|out of memory", re.IGNORECASE)  # PyTorch raises RuntimeError

# What programs need beyond a plain install, by the name of the module.
_EXTRAS = (
    *("tyro", "rich", "yaml", "tensorboard", "matplotlib"),
    *("astropy", "imageio", "skimage", "kornia", "trimesh"),
    *("cma", "joblib", "ezdxf", "speclite"),
)


def run_script(
    name: str,
    run: Callable[[T], int | None],
    options: type[T],
    description: str | None,
    argv: Sequence[str] | None = None,
) -> int:
    """Parse the options of a script and run it; returns the exit status.

    Parameters
    ----------
    name : str
        Name of the script, which begins every message and is stored in its config files.
    run : callable
        Function that does the work and may return an exit status. ValueError and OSError are taken as mistakes of the
        user and shown as one line.
    options : type
        Dataclass whose fields are the options; those of `torchmask.cli.options` add --config, --debug and --out.
    description : str, optional
        Heads the help, usually the docstring of the script.
    argv : sequence of str, optional
        None: the arguments of the process.

    Raises SystemExit (2, or 0 for --help) from parsing the options.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    return exit_status(
        name,
        lambda: carry_out(run, parse(options, name, arguments, prog=name, description=description)),
        debug="--debug" in arguments,
    )


def carry_out(run: Callable[[T], int | None], options: T) -> int | None:
    """Run a program with its options. Raises ValueError as `run` does, but in the words of the command line."""
    try:
        _require_seeds(options)
        return run(options)
    except ValueError as error:
        raise ValueError(in_options(str(error), options)) from error


def _require_seeds(options: Any) -> None:
    """Raise ValueError for a seed of more bits than generators of random numbers take, of which they say little."""
    given = getattr(options, "seed", ())
    for seed in given if isinstance(given, tuple) else (given,):
        if isinstance(seed, int) and abs(seed) > _LARGEST_SEED:
            raise ValueError(f"seed is {seed}: it must be a whole number from 0 to {_LARGEST_SEED} (2**63 - 1)")


def exit_status(program: str, work: Callable[[], int | None], debug: bool) -> int:
    """Do the work; mistakes and warnings become one line each, unless `debug` asks for the traceback."""
    with warnings.catch_warnings():
        told: set[str] = set()
        warnings.showwarning = lambda message, *_, **__: _warn(program, str(message), told)
        try:
            with _interrupted_by_termination():
                return work() or 0
        except KeyboardInterrupt:
            if debug:
                raise
            _say(program, "interrupted")
            return 130
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if debug or missing not in _EXTRAS:
                raise
            _say(program, f"needs {missing}, which a plain install leaves out: pip install 'torchmask[experiments]'")
            return 1
        except (MemoryError, RuntimeError) as error:
            if debug or not (isinstance(error, MemoryError) or _NO_MEMORY.search(str(error))):
                raise
            _say(program, f"error: memory is short, take fewer or smaller frames, frequencies, holes or modes: {error}")
            return 1
        except BrokenPipeError:  # `torchmask masks | head` has read enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
            return 1
        except (ValueError, OSError) as error:
            if debug:
                raise
            _say(program, f"error: {error}")
            return 1


@contextmanager
def _interrupted_by_termination() -> Iterator[None]:
    """Let SIGTERM interrupt like Ctrl-C; only the main thread may ask for that, so others change nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def parse(options: type[T], command: str, argv: Sequence[str], *, prog: str, description: str | None = None) -> T:
    """Return the options of a program: those in `argv`, else of the file behind --config, else the defaults.

    Without --config the file is that of the run behind --resume, or what the instrument behind --instrument says, for a
    program that has these options.

    Raises ValueError for values that an option cannot have and for a config file that `load_config` refuses, SystemExit
    for wrong usage and for --help.
    """
    import tyro

    early = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    known = {field.name for field in dataclasses.fields(typing.cast(Any, options))}
    for name in known & {"config", "resume", "instrument"}:
        early.add_argument(f"--{name}", type=Path)
    given = vars(early.parse_known_args(argv)[0])
    path, resumed = given.get("config"), given.get("resume")
    if path is None and resumed is not None:
        if not resumed.is_dir():
            raise ValueError(f"there is no folder {resumed}: --resume goes on with a run, so give the folder of one")
        path = resumed / CONFIG
    instrument = given.get("instrument")
    if instrument is not None and path is not None:
        raise ValueError("--instrument and --config both say what is not given here: give one")
    default: dict[str, Any] = {} if path is None else {"default": load_config(path, options, command)}
    if instrument is not None:
        default["default"] = typing.cast(Any, options).of_instrument(Instrument.load(instrument))
    with _checks_deferred(options) as mistakes:
        found = tyro.cli(options, prog=prog, args=argv, description=description, **default)
    if mistakes:
        told = list(dict.fromkeys(in_options(str(mistake), found) for mistake in mistakes))
        if len(told) > 1:
            told = [f"({number}) {message}" for number, message in enumerate(told, 1)]
        raise ValueError("; ".join(told)) from mistakes[0]
    return found


@contextmanager
def _checks_deferred(options: type) -> Iterator[list[ValueError]]:
    """Collect the mistakes that groups of options find in themselves, until all options are parsed.

    Groups check themselves when they are made, and tyro would call an error then wrong usage.
    """
    mistakes: list[ValueError] = []
    kinds = {kind for group in _groups(options) for kind in group.__mro__ if "__post_init__" in vars(kind)}
    checks = {kind: kind.__post_init__ for kind in kinds}

    def deferred(check: Callable[[Any], None]) -> Callable[[Any], None]:
        def note(self: Any) -> None:
            try:
                check(self)
            except ValueError as error:
                mistakes.append(error)

        return note

    for kind, check in checks.items():
        kind.__post_init__ = deferred(check)
    try:
        yield mistakes
    finally:
        for kind, check in checks.items():
            kind.__post_init__ = check


def _groups(options: type) -> set[Any]:
    """Return the dataclasses that `options` is made of, itself among them."""
    found = {options}
    for hint in typing.get_type_hints(options).values():
        if dataclasses.is_dataclass(hint):
            found |= _groups(typing.cast(type, hint))
    return found


def _warn(program: str, message: str, told: set[str]) -> None:
    """Print a warning unless it has been `told`: Python forgets which it has shown whenever filters change."""
    if message not in told:
        told.add(message)
        _say(program, f"warning: {message}")


def _say(program: str, message: str) -> None:
    """Print a message on standard error, as one line."""
    print(f"{program}: {' '.join(message.split())}", file=sys.stderr)
