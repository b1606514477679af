"""The command `camtorch board`: a board to print and to photograph."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from camtorch.cli.boards import add_board, parse_length
from camtorch.cli.options import add_output

if TYPE_CHECKING:
    from camtorch.boards.boards import Board
    from camtorch.cli.options import Commands

_PAPERS = ("a4", "a3", "a2", "a1", "a0", "letter", "legal", "tabloid")


def parse_paper(text: str) -> str | tuple[float, float]:
    """The name of a paper, or (width, height) in mm of "WIDTHxHEIGHT", as in 400x300mm."""
    name = text.lower()
    if name in (*_PAPERS, "board"):
        return name
    unit = next((unit for unit in ("mm", "cm", "in", "m") if name.endswith(unit)), "mm")
    sides = name.removesuffix(unit).split("x")
    if len(sides) != 2:
        known = ", ".join(_PAPERS)
        raise argparse.ArgumentTypeError(f"{text!r} is no paper: {known}, board, or WIDTHxHEIGHT, as in 400x300mm")
    width, height = (1000 * parse_length(f"{side}{unit}") for side in sides)
    return width, height


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "board",
        help="draw a board to print, for camtorch calibrate",
        description="Draw a board to print, to scale: camtorch board --board 9x6 --square 25mm -o board.pdf. "
        "Print it at 100 % (no fit to page), on something flat.",
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    add_board(command, "by default as many whole millimetres as fit on the paper")
    command.add_argument(
        "--paper",
        type=parse_paper,
        default="a4",
        metavar="NAME",
        help=f"{', '.join(_PAPERS)}, WIDTHxHEIGHT as in 400x300mm, or board: as large as needed; a4 by default",
    )
    add_output(command, "board.pdf", "the drawing, a .pdf or .svg")


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    from camtorch.boards import printing
    from camtorch.cli import targets
    from camtorch.cli.boards import read_board, said
    from camtorch.io.writing import replacing

    path = arguments.output
    if path.suffix.lower() not in (".pdf", ".svg"):
        raise ValueError(f"{path}: a board is drawn as .pdf or .svg")
    targets.check(path, force=arguments.force)
    paper = printing.PAPERS.get(arguments.paper, arguments.paper)
    if paper == "board":
        paper = None
    board = read_board(arguments, 0.03)
    if arguments.square is None and paper is not None:
        board = _fitting(arguments, board, paper)
    page = printing.page(board, paper, (board.words("m"), "camtorch calibrate IMAGES -o camera.yml", said(board)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as (file,):
        file.write(printing.as_pdf(page) if path.suffix.lower() == ".pdf" else printing.as_svg(page).encode())
    print(f"{path}: {board.words('m')}, on {page.width:.4g} x {page.height:.4g} mm; print it at 100 %")


def _fitting(arguments: argparse.Namespace, board: Board, paper: tuple[float, float]) -> Board:
    """The board as large as whole millimetres of a square or tag allow."""
    from camtorch.boards import printing
    from camtorch.cli.boards import read_board

    part = max(printing.largest(board, sides) for sides in (paper, paper[::-1]))
    side = math.floor(1000 * part * board.square + 1e-6) / 1000
    if side <= 0:
        raise ValueError(f"on paper of {paper[0]:g} x {paper[1]:g} mm a square would be less than a millimetre")
    return read_board(argparse.Namespace(**vars(arguments) | {"square": side}), side)
