"""The calibration board (ChArUco): as a sheet to print, its views in a stream, and the lens.

Views are selected, and the missing ones are named, until there are enough.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image as PillowImage

from companion.errors import RecordError
from companion.setup.write import read_stream_size
from companion.sources import SourceSettings, open_source
from companion.writing import make_folder, result_file, writing
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.pictures import write_rgb
from localizer.types import Image

_LEAST_CORNERS = 12
_WINDOW = 0.08  # half, of a square's side: beyond it are the markers' own corners
_REFINE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
_STILL_SHARE = 0.004  # of the picture's width, from one picture to the next
_NEW = 0.16  # how much a view differs from all that are kept, see `_signature`
_COLUMNS, _ROWS, _IN_CELL = 5, 4, 4
_TILT_DEG, _EACH = 15.0, 2
_LARGE_SHARE = 0.55  # of the picture's width or height
_ENOUGH = 16
_TILTS = ("left", "right", "up", "down")
_ACROSS = ("left edge", "left", "middle", "right", "right edge")
_DOWN = ("top", "upper half", "lower half", "bottom")


@dataclass(frozen=True)
class BoardView:
    """The board in one image. objects: (N, 3), in squares; pixels: (N, 2), centres at + 0.5;
    signature: (5,) position, size and tilt, scaled so that 1 is a large change.
    """

    objects: Array
    pixels: Array
    signature: Array


class BoardViews:
    """Takes images of one camera in order and keeps the views of the board that add information."""

    def __init__(self, width: int, height: int) -> None:
        self._size = (width, height)
        self._board = charuco()
        self._detector = cv2.aruco.CharucoDetector(self._board)
        self._guess = Camera.from_fov(width, height, 65.0)  # tells a tilt to some degrees
        self._last: tuple[Array, Array] | None = None
        self.views: list[BoardView] = []

    def add_image(self, image: Image) -> str:
        """Add the next image (H, W, 3); returns the result in words for the user, "taken" if its
        view is kept. The board must stand still since the image before.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, names, _, _ = self._detector.detectBoard(grey)
        if names is None or len(names) < _LEAST_CORNERS:
            self._last = None
            return "no board, or less than a fifth of it"
        half = max(2, round(_WINDOW * _side_px(names.ravel(), corners.reshape(-1, 2))))
        refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), _REFINE)
        pixels, ids = refined.reshape(-1, 2).astype(np.float64) + 0.5, names.ravel()
        is_still = self._is_still(ids, pixels)
        self._last = ids, pixels
        if not is_still:
            return "hold it still"
        objects = self._board.getChessboardCorners()[ids].astype(np.float64)
        view = self._view(objects, pixels)
        if view is None:
            return "its corners lie on a line"
        if any(np.linalg.norm(view.signature - v.signature) < _NEW for v in self.views):
            return "like one that is there: move or tilt it"
        self.views.append(view)
        return "taken"

    def missing(self) -> list[str]:
        """What the next views should show; empty if there are enough."""
        wanted = []
        cells = np.zeros((_ROWS, _COLUMNS), int)
        for view in self.views:
            u = np.clip(view.pixels[:, 0] / self._size[0] * _COLUMNS, 0, _COLUMNS - 1e-6)
            v = np.clip(view.pixels[:, 1] / self._size[1] * _ROWS, 0, _ROWS - 1e-6)
            np.add.at(cells, (v.astype(int), u.astype(int)), 1)
        wanted += [
            f"the board in the image's {_DOWN[r]}, {_ACROSS[c]}"
            for r, c in np.argwhere(cells < _IN_CELL)
        ]
        tilts = np.array([view.signature[3:] * 90.0 for view in self.views]).reshape(-1, 2)
        sides = (tilts[:, 0] < -_TILT_DEG, tilts[:, 0] > _TILT_DEG,
                 tilts[:, 1] < -_TILT_DEG, tilts[:, 1] > _TILT_DEG)  # fmt: skip
        wanted += [
            f"the board turned {name} by 15 to 45 degrees"
            for name, side in zip(_TILTS, sides, strict=True)
            if side.sum() < _EACH
        ]
        large = [self._share(view.pixels) > _LARGE_SHARE for view in self.views]
        if sum(large) < _EACH:
            wanted.append("the board nearer: over half of the image")
        if not wanted and len(self.views) < _ENOUGH:
            wanted.append(f"{_ENOUGH - len(self.views)} more views, each another one")
        return wanted

    def _is_still(self, ids: Array, pixels: Array) -> bool:
        """Whether the corners have not moved since the last image, so that there is no blur and no
        rolling-shutter shear.
        """
        if self._last is None:
            return False
        common, now, before = np.intersect1d(ids, self._last[0], return_indices=True)
        if len(common) < _LEAST_CORNERS // 2:
            return False
        moved = np.hypot(*(pixels[now] - self._last[1][before]).T)
        return float(np.median(moved)) < _STILL_SHARE * self._size[0]

    def _share(self, pixels: Array) -> float:
        return float((np.ptp(pixels, axis=0) / self._size).max())

    def _view(self, objects: Array, pixels: Array) -> BoardView | None:
        K = self._guess.K
        if np.linalg.matrix_rank(objects[:, :2] - objects[0, :2], tol=1e-6) < 2:
            return None
        found, rotation, _ = cv2.solvePnP(objects, pixels, K, None)
        if not found:
            return None
        normal = cv2.Rodrigues(rotation)[0][:, 2]
        normal = normal if normal[2] > 0 else -normal
        tilt = np.degrees(np.arctan2(normal[:2], normal[2])) / 90.0
        middle = pixels.mean(axis=0) / self._size
        return BoardView(objects, pixels, np.array([*middle, np.log(self._share(pixels)), *tilt]))


def _side_px(ids: Array, pixels: Array) -> float:
    """Side of a square in the image, pixels; the shorter one of a tilted board."""
    place = {int(name): pixel for name, pixel in zip(ids, pixels, strict=True)}
    row = ACROSS - 1
    sides = []
    for step in (1, row):
        pairs = [(a, a + step) for a in place if a + step in place]
        same = [p for p in pairs if step == row or p[0] // row == p[1] // row]
        if same:
            sides.append(np.median([np.hypot(*(place[a] - place[b])) for a, b in same]))
    return float(min(sides, default=0.0))


Paper = Literal["a4", "a3", "letter"]
ACROSS, DOWN = 8, 11  # squares
_MARKER = 0.72  # of a square's side
_DICTIONARY = cv2.aruco.DICT_4X4_100
_DOTS_PER_SQUARE = 200
_TEXT_MM = 5.0  # below the board


@dataclass(frozen=True)
class BoardPage:
    """A page with the board in its middle, millimetres."""

    width_mm: float
    height_mm: float
    square_mm: float


# Of each paper with the largest board that leaves a printer's margins.
_PAGES = {
    "a4": BoardPage(210.0, 297.0, 23.0), "a3": BoardPage(297.0, 420.0, 33.0),
    "letter": BoardPage(215.9, 279.4, 22.0),
}  # fmt: skip


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
    sheet = _PAGES[paper]
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


OnView = Callable[[int, str, list[str]], None]
_QUIET_PICTURES = 30  # of the same word, after which it is said again


@dataclass(frozen=True)
class BoardViewing:
    """Result of the collection. missing: views that are still missing."""

    views: tuple[BoardView, ...]
    missing: tuple[str, ...]
    width: int
    height: int


def watch_board(
    source: str, seconds: float, on_view: OnView, keep: Path | None = None
) -> BoardViewing:
    """Collect views of the board until all are there, the source ends, or `seconds` have passed.

    source: as `open_source`. on_view: called after each change, and after each 30 images without
    one, with the number of views, the result of the newest image and the missing views. keep:
    folder for the images used, which is created; None for none. `StreamError` if the source fails.
    """
    width, height = read_stream_size(source)
    views = BoardViews(width, height)
    # Any model of the pictures' size: it is what is being looked for.
    camera = Camera.from_fov(width, height, 65.0)
    feed = open_source(source, camera, SourceSettings())
    timer = threading.Timer(seconds, feed.close)
    timer.daemon = True
    timer.start()
    if keep is not None:
        make_folder(keep, "--keep")
    last, quiet = "", 0
    try:
        for frame in feed.frames():
            word = views.add_image(frame.image)
            quiet = 0 if word != last else quiet + 1
            if word == "taken" and keep is not None:
                write_rgb(keep / f"view-{len(views.views):03d}.png", frame.image)
            if quiet % _QUIET_PICTURES == 0:
                on_view(len(views.views), word, views.missing())
            last = word
            if word == "taken" and not views.missing():
                break
    finally:
        timer.cancel()
        feed.close()
    return BoardViewing(tuple(views.views), tuple(views.missing()), width, height)


_LEAST_VIEWS = 8
_OUTLIER = 3.0  # medians of a view's own error: blurred, or a bent board
_K3_GAIN = 0.97  # k3 is used where the errors fall below this share without it
_SIGMA_FACTOR = 2.0  # a board is not flat, and its corners do not err independently


@dataclass(frozen=True)
class LensEstimate:
    """The camera model. sigmas: (9,) of fx, fy, cx, cy, k1, k2, p1, p2, k3; rms_px: of the corners;
    views: number used, number in all.
    """

    camera: Camera
    sigmas: Array
    rms_px: float
    views: tuple[int, int]


def solve_lens(views: Sequence[BoardView], width: int, height: int) -> LensEstimate:
    """Estimate the camera from views (Zhang 2000), without those whose error is three times the
    median. width, height: of their images, px. `RecordError` with fewer than eight views.
    """
    if len(views) < _LEAST_VIEWS:
        raise RecordError(
            f"{len(views)} usable views of the board; the camera's model needs {_LEAST_VIEWS}, "
            "better 16: all over the image, near, and tilted"
        )
    used = list(views)
    lens, errors = _fit(used, (width, height), with_k3=False)
    kept = [v for v, e in zip(used, errors, strict=True) if e <= _OUTLIER * np.median(errors)]
    if _LEAST_VIEWS <= len(kept) < len(used):
        used, lens = kept, _fit(kept, (width, height), with_k3=False)[0]
    more, _ = _fit(used, (width, height), with_k3=True)
    found = more if more.rms_px < _K3_GAIN * lens.rms_px else lens
    return replace(found, views=(len(used), len(views)))


def _fit(
    views: Sequence[BoardView], size: tuple[int, int], *, with_k3: bool
) -> tuple[LensEstimate, Array]:
    """The camera model, and the error of each view, (N,) px."""
    objects = [v.objects.astype(np.float32) for v in views]
    # Corners count from the picture's edge here, so the principal point does, too.
    pixels = [v.pixels.astype(np.float32) for v in views]
    flags = 0 if with_k3 else cv2.CALIB_FIX_K3
    rms, K, d, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
        objects, pixels, size, np.eye(3), np.zeros(5), flags=flags
    )
    k1, k2, p1, p2, k3 = map(float, np.ravel(d)[:5])
    camera = Camera(
        *size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), (k1, k2, p1, p2, k3)
    )
    wide = _SIGMA_FACTOR * np.asarray(sigmas, np.float64).ravel()[:9]
    return LensEstimate(camera, wide, float(rms), (len(views),) * 2), np.ravel(errors)
