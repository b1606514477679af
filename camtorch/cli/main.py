"""The command line `camtorch`: running commands and showing errors."""

import argparse
import difflib
import gc
import importlib
import importlib.metadata
import io
import os
import sys
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from camtorch import __version__
from camtorch.cli import commands, processes
from camtorch.cli.terminal import lacks_memory, note, reason, say
from camtorch.native import library

_OTHER_NAMES = {"undistort": "dewarp", "view": "show", "plot": "show", "info": "show"}  # that other tools give commands
_CLOSE = 0.65  # as difflib has it: unwarp and dewarp are, corners and border are not


class _Parser(argparse.ArgumentParser):
    commands: Iterable[str] = ()

    def __init__(self, **options: Any):
        super().__init__(allow_abbrev=False, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Return what arguments say; unknown ones raise an error here, where a command knows its options."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        name, hint = message.partition("unrecognized arguments: ")[2].split(" ")[0], f"see {self.prog} --help"
        command = message.partition("argument COMMAND: invalid choice: ")[2].partition(" (choose")[0].strip("'\"")
        if os.path.splitext(name)[1] and not name.startswith("-") and not os.path.exists(name):
            message += f"; -o {name} names the new file"
        elif name.startswith("-") or message.startswith("argument COMMAND: invalid choice"):
            message += self._question_about(command, name.partition("=")[0])
            hint += "; commands and options of 0.3 that are gone: docs/leaving-0.3.md"
        raise ValueError(f"{message} ({hint})")

    def _question_about(self, command: str, option: str) -> str:
        """Return whether a known command, or else option, is meant: one that begins so or is close; or nothing."""
        if command:
            known = {name: name for name in self.commands} | _OTHER_NAMES
        else:
            known = {name.lstrip("-"): name for name in self._option_string_actions if name.startswith("--")}
        word = command or option.lstrip("-")
        begin = [name for name in known if word and name.startswith(word)]
        meant = begin or difflib.get_close_matches(word, known, 1, _CLOSE)
        return f"; did you mean {known[meant[0]]}?" if meant else ""


class _Version(argparse.Action):
    """Action that prints the versions on which results depend, without importing the libraries."""

    def __call__(self, *_: object) -> NoReturn:
        try:
            torch = importlib.metadata.version("torch")
        except importlib.metadata.PackageNotFoundError:
            torch = "not installed"
        print(f"camtorch {__version__}, torch {torch}, native sampler: {library.state()}")
        sys.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`, by default the process's own, and return the exit status.

    The status is 0; 1 if some of many files failed; 2 after an error, which is one line on stderr; 130 after an
    interrupt; 141 if the reader of the output closed it.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in ("strict", "surrogateescape"):
        sys.stdout.reconfigure(errors="backslashreplace")  # for names of files that its encoding lacks
    if sys.stderr is None:  # closed by the shell; a bar asks whether it is a terminal
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    try:
        arguments = make_parser().parse_args(argv)
        module = f"camtorch.cli.{arguments.command}"
        if arguments.command == "dewarp" and arguments.jobs != 1 and commands.are_several(arguments.image):
            processes.prepare(module)  # processes import in parallel with this one
        if "torch" not in sys.modules:  # its import takes a second, and half of one more if garbage is collected
            gc.disable()
        try:
            command = importlib.import_module(module)
        finally:
            if not gc.isenabled():
                gc.freeze()  # the modules stay
                gc.enable()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            status: int = command.run(arguments) or 0
        for warning in caught:
            note(warning.message)
        print(end="", flush=True)  # unless stdout is closed
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + 13  # as shells do for the signal
    except KeyboardInterrupt:
        say("interrupted")
        return 128 + 2
    except Exception as error:
        if not (isinstance(error, (ValueError, ImportError, OSError)) or lacks_memory(error)):
            raise
        say(f"error: {reason(error)}")
        return 2
    return status


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all options, which also generates the page of commands."""
    parser = _Parser(prog="camtorch", description="Cameras as layers for PyTorch.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show what is installed and exit")
    subparsers = parser.add_subparsers(title="commands", dest="command", required=True, metavar="COMMAND")
    commands.add_all(subparsers)
    parser.commands = subparsers.choices
    return parser
