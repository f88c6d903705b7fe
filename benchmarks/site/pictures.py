"""The README's two pictures, of a demo flight's report: an overlay, and the track over its map."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from companion.errors import ReportError
from companion.reporting.content import MapSheet, Overlay
from companion.reporting.demo import demo_report
from localizer.types import Image

_WIDEST = {"overlay": 1440, "flight": 900}
_MOST_BYTES = 400_000
_CELLS = 8  # of the checkerboard, across the width


def keep(folder: Path, out: Path) -> list[Path]:
    """JPEGs below 400 kB. RecordError where the folder is not that of a demo flight; ReportError
    where it holds no pictures.
    """
    report = demo_report(folder)
    if report.sheet is None or not report.overlays:
        raise ReportError(f"{folder}: no picture; give the report folder of `make demo`")
    pictures = {"overlay": _overlay(report.overlays[0]), "flight": _flight(report.sheet)}
    kept = []
    for name, picture in pictures.items():
        share = min(1.0, _WIDEST[name] / picture.shape[1])
        small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        kept.append(_written(cv2.cvtColor(small, cv2.COLOR_RGB2BGR), out / f"{name}.jpg"))
    return kept


def _overlay(shown: Overlay) -> Image:
    """Video, render and their checkerboard side by side: edges run on where the pose is right."""
    height, width = shown.video.shape[:2]
    side = max(1, width // _CELLS)
    rows, columns = np.arange(height) // side, np.arange(width) // side
    from_video = ((rows[:, None] + columns[None, :]) % 2 == 0)[..., None]
    board = np.where(from_video, shown.video, shown.render)
    return np.hstack([shown.video, shown.render, board]).astype(np.uint8)


def _flight(sheet: MapSheet) -> Image:
    """The tracks over the map, each thinner than the one before."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot(xlabel="east, m", ylabel="north, m")
    if sheet.rgb is not None:
        edges = (sheet.west, sheet.east, sheet.south, sheet.north)
        axes.imshow(sheet.rgb, extent=edges, alpha=0.75)
    for track in sheet.tracks:
        axes.plot(*track.points.T, color=track.colour, linewidth=track.width / 2, label=track.name)
    for mark in sheet.marks:
        axes.plot(mark.east_m, mark.north_m, "k+", markersize=9)
        axes.annotate(mark.name, (mark.east_m, mark.north_m), (5, 5), textcoords="offset points")
    figure.legend(loc="outside lower center", ncols=4, facecolor="0.7", framealpha=1.0)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba(), np.uint8)[..., :3]


def _written(picture: cv2.typing.MatLike, path: Path) -> Path:
    for quality in (85, 75, 65, 55):
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if data.size <= _MOST_BYTES:
            path.write_bytes(data.tobytes())
            return path
    raise ReportError(f"{path}: {data.size} bytes at quality 55, {_MOST_BYTES} are the most")
