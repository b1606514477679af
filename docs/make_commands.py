"""Write docs/commands.md, all commands with all options, from the parser: python docs/make_commands.py."""

from __future__ import annotations

import argparse
from pathlib import Path

from camtorch.cli.main import make_parser

PAGE = Path(__file__).parent / "commands.md"
HEAD = """# All commands and options

Made from what the command itself knows, by `python docs/make_commands.py`. What each is for, with examples:
[the command line](guides/command-line.md). Sizes are WIDTHxHEIGHT and angles degrees.
"""


def text() -> str:
    """The whole page."""
    (commands,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return HEAD + "".join(_section(name, command) for name, command in commands.choices.items())


def _section(name: str, command: argparse.ArgumentParser) -> str:
    lines = [f"\n## camtorch {name}\n", f"{_cell(command.description or '')}\n", "| | |\n|---|---|"]
    for action in command._actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction):
            continue
        value = "" if action.nargs == 0 else _value(action)
        names = ", ".join(f"`{one}{value}`" for one in action.option_strings) or f"`{value.strip()}`"
        lines.append(f"| {_cell(names)} | {_cell(action.help or '')} |")
    return "\n".join(lines) + "\n"


def _value(action: argparse.Action) -> str:
    metavar = action.metavar if action.metavar is not None else action.dest.upper()
    if action.choices is not None and action.metavar is None:
        metavar = "{" + ",".join(map(str, action.choices)) + "}"
    one = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    return {"+": f" {one} ...", "*": f" [{one} ...]", "?": f" [{one}]"}.get(str(action.nargs), f" {one}")


def _cell(words: str) -> str:
    return " ".join(words.replace("%%", "%").replace("|", "\\|").split())


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
