"""The command line: `torchmask COMMAND ...`."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from torchmask import __version__
from torchmask.cli.program import carry_out, exit_status, parse

COMMANDS = {
    "plan": "predict how many holes, of what size, and what exposure an observation needs",
    "design": "search the mask with the smallest error of the restored image",
    "table": "compare numbers of holes, hole sizes, light and turbulence, with a search for each",
    "rank": "rank the masks of the catalogue, and your own, by the error of the restored image",
    "simulate": "draw short exposures of a scene through a mask and turbulence",
    "restore": "restore the image behind a stack of short exposures (.npz or FITS)",
    "calibrate": "measure how a mask lies, on exposures of a star",
    "companion": "look for a companion beside a star in OIFITS files",
    "codesign": "all of it at once: design, simulate, restore, compare with a full pupil",
    "masks": "list the catalogue of masks, or show one",
    "view": "draw a mask, a stack, a result or a run, and say what it holds",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status, or raises SystemExit (2, or 0 for --help) from parsing the options.

    The statuses are those of `torchmask.cli.program`.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = _parser()
    command = parser.parse_args(arguments[:1]).command
    program = f"torchmask {command}"

    def work() -> int | None:
        module = importlib.import_module(f"torchmask.cli.{command}")
        return carry_out(module.run, parse(module.Options, command, arguments[1:], prog=program))

    return exit_status(program, work, debug="--debug" in arguments)


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
