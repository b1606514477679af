"""The command `camtorch board`: a board to print and to photograph; and the board that a command's options say."""

from __future__ import annotations

import argparse
import math

from camtorch.boards import printing
from camtorch.cli import targets
from camtorch.cli.calibrate import _read_board as read_board
from camtorch.io.writing import replacing


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    path = arguments.output
    if path.suffix.lower() not in (".pdf", ".svg"):
        raise ValueError(f"{path}: a board is drawn as .pdf or .svg")
    targets.check(path, force=arguments.force)
    paper = None if arguments.paper == "board" else printing.PAPERS.get(arguments.paper, arguments.paper)
    board = read_board(arguments, 0.03)
    if arguments.square is None and paper is not None:
        # as large as whole millimetres of a square or tag allow
        part = max(printing.largest(board, sides) for sides in (paper, paper[::-1]))
        side = math.floor(1000 * part * board.square + 1e-6) / 1000
        if side <= 0:
            raise ValueError(f"on paper of {paper[0]:g} x {paper[1]:g} mm a square would be less than a millimetre")
        board = read_board(arguments, side)
    # what says to `camtorch calibrate` which board it is
    options = board.options()
    said = [f"--type {options.pop('type')} --board {options.pop('columns')}x{options.pop('rows')}"]
    for name, value in options.items():
        if value is not False:
            said.append(
                f"--{name}" + ("" if value is True else f" {value:.6g}" if isinstance(value, float) else f" {value}")
            )
    page = printing.page(board, paper, (board.words("m"), "camtorch calibrate IMAGES -o camera.yml", " ".join(said)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as (file,):
        file.write(printing.as_pdf(page) if path.suffix.lower() == ".pdf" else printing.as_svg(page).encode())
    print(f"{path}: {board.words('m')}, on {page.width:.4g} x {page.height:.4g} mm; print it at 100 %")
