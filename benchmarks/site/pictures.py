"""The README's two pictures, of a demo flight's report: an overlay, and the track over its map."""

from __future__ import annotations

from pathlib import Path

import cv2

from companion.errors import ReportError

_WIDEST = {"overlay": 1440, "flight": 900}
_MOST_BYTES = 400_000


def keep(report: Path, out: Path) -> list[Path]:
    """JPEGs below 400 kB. ReportError where the folder is not that of a demo flight's report."""
    wanted = {"overlay": report / "overlay-1.png", "flight": report / "tracks.png"}
    kept = []
    for name, path in wanted.items():
        picture = cv2.imread(str(path))
        if picture is None:
            raise ReportError(f"{path}: no picture; give the report folder of `make demo`")
        share = min(1.0, _WIDEST[name] / picture.shape[1])
        small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        kept.append(_written(small, out / f"{name}.jpg"))
    return kept


def _written(picture: cv2.typing.MatLike, path: Path) -> Path:
    for quality in (85, 75, 65, 55):
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if data.size <= _MOST_BYTES:
            path.write_bytes(data.tobytes())
            return path
    raise ReportError(f"{path}: {data.size} bytes at quality 55, {_MOST_BYTES} are the most")
