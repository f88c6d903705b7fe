"""The calibration board (ChArUco), as a sheet to print at true scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image as PillowImage

from companion.writing import result_file, writing
from localizer.types import Image

Paper = Literal["a4", "a3", "letter"]
ACROSS, DOWN = 8, 11  # squares
_MARKER = 0.72  # of a square's side
_DICTIONARY = cv2.aruco.DICT_4X4_100
_SHEETS_MM: dict[str, tuple[float, float, float]] = {  # width, height, square
    "a4": (210.0, 297.0, 23.0), "a3": (297.0, 420.0, 33.0), "letter": (215.9, 279.4, 22.0),
}  # fmt: skip
_DOTS_PER_SQUARE = 200
_TEXT_MM = 5.0  # below the board


@dataclass(frozen=True)
class BoardPage:
    """A page with the board in its middle, millimetres."""

    width_mm: float
    height_mm: float
    square_mm: float

    @classmethod
    def of(cls, paper: Paper) -> BoardPage:
        """The page of that paper with the largest board that leaves a printer's margins."""
        return cls(*_SHEETS_MM[paper])


def charuco() -> cv2.aruco.CharucoBoard:
    """The ChArUco board with a square's side of 1; the calibration does not need its size."""
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    return cv2.aruco.CharucoBoard((ACROSS, DOWN), 1.0, _MARKER, dictionary)


def board_picture(dots: int = _DOTS_PER_SQUARE) -> Image:
    """The board as a grey image (11 dots, 8 dots), without a margin."""
    picture = charuco().generateImage((ACROSS * dots, DOWN * dots), marginSize=0)
    return np.asarray(picture, np.uint8)


def write_sheet(path: Path, paper: Paper) -> BoardPage:
    """Write the board as PDF or PNG, by the file's suffix, and return its measures. `ReportError`
    for another suffix, or if it cannot be written.
    Printed at 100 %, the squares have the size stated on the sheet.
    """
    sheet = BoardPage.of(paper)
    result_file(path, "--print", (".pdf", ".png"))
    dots_per_inch = 25.4 * _DOTS_PER_SQUARE / sheet.square_mm
    with writing(path, "--print"):
        if path.suffix.lower() == ".pdf":
            _page(sheet).convert("1").save(path, resolution=dots_per_inch)
        else:
            _page(sheet).save(path, dpi=(dots_per_inch, dots_per_inch))
    return sheet


def _page(sheet: BoardPage) -> PillowImage.Image:
    """The white page with the board in its middle, and the size of a square below it."""
    per_mm = _DOTS_PER_SQUARE / sheet.square_mm
    board = board_picture(_DOTS_PER_SQUARE)
    page = np.full((round(sheet.height_mm * per_mm), round(sheet.width_mm * per_mm)), 255, np.uint8)
    top, left = (page.shape[0] - board.shape[0]) // 2, (page.shape[1] - board.shape[1]) // 2
    bottom = top + board.shape[0]
    page[top:bottom, left : left + board.shape[1]] = board
    say = f"print at 100 %: a square is {sheet.square_mm:g} mm. ChArUco 8 x 11, DICT_4X4_100"
    below = (left, bottom + round(_TEXT_MM * per_mm))
    cv2.putText(page, say, below, cv2.FONT_HERSHEY_SIMPLEX, 0.8, 0, 2, cv2.LINE_AA)
    return PillowImage.fromarray(page)
