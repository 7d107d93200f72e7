"""The command line: `torchmask COMMAND ...`.

Exit status: 0 done; 1 something the user can mend, said in one line; 2 wrong usage; 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import warnings
from collections.abc import Sequence

from torchmask import __version__

COMMANDS = {
    "design": "search the mask with the smallest error of the restored image",
    "simulate": "draw short exposures of a scene through a mask and turbulence",
    "restore": "restore the image behind a stack of short exposures (.npz or FITS)",
    "codesign": "all of it at once: design, simulate, restore, compare with a full pupil",
    "masks": "list the catalogue of masks, or show one",
    "view": "draw a mask, a stack, a result or a run, and say what it holds",
}
# What the commands need beyond a plain install, by the name of the module.
_EXTRAS = ("tyro", "rich", "yaml", "tensorboard", "matplotlib", "astropy", "cma", "imageio", "skimage", "kornia")
_EXTRAS += ("trimesh", "ezdxf")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status, or raises SystemExit (2, or 0 for --help) from parsing the options."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = _parser()
    command = parser.parse_args(arguments[:1]).command
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: _say(command, f"warning: {message}")
        return _run(command, arguments[1:])


def _parser() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    parser = argparse.ArgumentParser(
        prog="torchmask",
        usage="torchmask COMMAND [OPTIONS]",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Design aperture masks, and restore images taken through turbulence with them.\n\ncommands:\n"
        + "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items()),
        epilog="`torchmask COMMAND --help` shows the options of a command, with their units.",
    )
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of those above")
    parser.add_argument("--version", action="version", version=f"torchmask {__version__}")
    return parser


def _run(command: str, argv: list[str]) -> int:
    debug = "--debug" in argv
    try:
        module = importlib.import_module(f"torchmask.cli.{command}")
        parse = importlib.import_module("torchmask.cli.config").parse
        module.run(parse(module.Options, command, argv))
    except KeyboardInterrupt:
        if debug:
            raise
        _say(command, "interrupted")
        return 130
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if debug or missing not in _EXTRAS:
            raise
        _say(command, f"needs {missing}, which a plain install leaves out: pip install 'torchmask[experiments]'")
        return 1
    except BrokenPipeError:  # `torchmask masks | head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return 1
    except (ValueError, OSError) as error:
        if debug:
            raise
        _say(command, f"error: {error}")
        return 1
    return 0


def _say(command: str, message: str) -> None:
    """One line on standard error, whatever the message looks like."""
    print(f"torchmask {command}: {' '.join(message.split())}", file=sys.stderr)
