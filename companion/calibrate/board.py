"""The calibration board (ChArUco), as a sheet to print at true scale."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

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
_POINTS_PER_MM = 72.0 / 25.4


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
    with writing(path, "--print"):
        path.write_bytes(_pdf(sheet) if path.suffix.lower() == ".pdf" else _png(sheet))
    return sheet


def _pdf(sheet: BoardPage) -> bytes:
    """A PDF page (1.4) with the board as an image that is placed by millimetres."""
    picture = board_picture(_DOTS_PER_SQUARE // 4)
    rows, columns = picture.shape
    packed = zlib.compress(picture.tobytes())
    w, h = (_POINTS_PER_MM * x for x in (sheet.width_mm, sheet.height_mm))
    bw, bh = (_POINTS_PER_MM * sheet.square_mm * n for n in (ACROSS, DOWN))
    x, y = (w - bw) / 2, (h - bh) / 2
    say = f"print at 100 %: a square is {sheet.square_mm:g} mm. ChArUco 8 x 11, DICT_4X4_100"
    page = (
        f"q {bw:.3f} 0 0 {bh:.3f} {x:.3f} {y:.3f} cm /I Do Q "
        f"BT /F 8 Tf {x:.1f} {max(y - 14, 8):.1f} Td ({say}) Tj ET"
    ).encode()
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        (
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w:.3f} {h:.3f}] /Contents 4 0 R "
            "/Resources << /XObject << /I 5 0 R >> /Font << /F 6 0 R >> >> >>"
        ).encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(page), page),
        b"<< /Type /XObject /Subtype /Image /Width %d /Height %d /ColorSpace /DeviceGray "
        b"/BitsPerComponent 8 /Filter /FlateDecode /Length %d >>\nstream\n%s\nendstream"
        % (columns, rows, len(packed), packed),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = bytearray(b"%PDF-1.4\n"), []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        len(objects) + 1, table,
    )  # fmt: skip
    return bytes(out)


def _png(sheet: BoardPage) -> bytes:
    """A white PNG with its dots per metre (pHYs), so that it prints at true scale."""
    dots = _DOTS_PER_SQUARE
    per_mm = dots / sheet.square_mm
    board = board_picture(dots)
    page = np.full((round(sheet.height_mm * per_mm), round(sheet.width_mm * per_mm)), 255, np.uint8)
    top, left = (page.shape[0] - board.shape[0]) // 2, (page.shape[1] - board.shape[1]) // 2
    page[top : top + board.shape[0], left : left + board.shape[1]] = board
    data = cv2.imencode(".png", page)[1].tobytes()
    density = struct.pack(">IIB", round(1000 * per_mm), round(1000 * per_mm), 1)
    body = b"pHYs" + density
    chunk = struct.pack(">I", len(density)) + body + struct.pack(">I", zlib.crc32(body))
    header = 33  # signature and IHDR
    return data[:header] + chunk + data[header:]
