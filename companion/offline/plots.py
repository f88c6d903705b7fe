"""Pictures for reports: checkerboard overlays, tracks on the map, errors over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from localizer.geometry.pose import Array
from localizer.pictures import write_rgb
from localizer.types import Image

mpl.use("Agg")

TRACK_STYLES = ((7.0, "white"), (3.5, "tab:orange"), (1.2, "black"))  # points; innermost last


def checkerboard(video: Image, render: Image, cells: int = 8) -> Image:
    """Video and render, both (H, W, 3), in alternating cells: edges run on where poses are right.

    cells: across the width.
    """
    height, width = video.shape[:2]
    side = max(1, width // cells)
    rows, columns = np.arange(height) // side, np.arange(width) // side
    from_video = ((rows[:, None] + columns[None, :]) % 2 == 0)[..., None]
    return np.where(from_video, video, render).astype(np.uint8)


def overlay_sheet(video: Image, render: Image, caption: str) -> Image:
    """Video, render and their checkerboard side by side, under what they are and a caption."""
    sheet = np.hstack([video, render, checkerboard(video, render)])
    bar = np.zeros((22, sheet.shape[1], 3), np.uint8)
    caption = f"video | map at the estimated pose | checkerboard   {caption}"
    cv2.putText(bar, caption, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
    return np.vstack([bar, sheet])


def save_image(path: Path, rgb: Image) -> None:
    """Write an RGB image as PNG or JPEG, by suffix."""
    write_rgb(path, rgb)


@dataclass(frozen=True)
class MapPicture:
    """A north-up picture of the map and the ENU rectangle it covers (m)."""

    rgb: Image
    west: float
    east: float
    south: float
    north: float


_SHAPES = "os^D"


def plot_tracks(
    path: Path,
    tracks: Mapping[str, Array],
    background: MapPicture | None,
    marks: Mapping[str, Array],
    located: Mapping[str, Array] | None = None,
) -> None:
    """Tracks (N, 2+) in ENU metres and named marks (2+,) over the map; located: every fix (M, 2+)
    of each target.

    Each is thinner than the one before: tracks that coincide are seen, one inside the other.
    """
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot()
    if background is not None:
        b = background
        axes.imshow(b.rgb, extent=(b.west, b.east, b.south, b.north), alpha=0.75)
    for i, (name, track) in enumerate(tracks.items()):
        width, colour = TRACK_STYLES[min(i, len(TRACK_STYLES) - 1)]
        axes.plot(track[:, 0], track[:, 1], color=colour, linewidth=width, label=name)
    for i, (name, track) in enumerate((located or {}).items()):
        # Ten colours, then another shape: no two look alike.
        shape = _SHAPES[i // 10 % len(_SHAPES)]
        colour = f"C{i % 10}"
        axes.plot(
            track[:, 0], track[:, 1], shape, color=colour, markersize=5, mfc="none", label=name
        )
    points = np.vstack([t[:, :2] for t in tracks.values()])
    low, high = points.min(axis=0) - 80, points.max(axis=0) + 80
    for name, mark in marks.items():
        axes.plot(mark[0], mark[1], "k+", markersize=9)
        # On the side where there is room: a name at the right edge would be cut.
        side = -1 if mark[0] > 0.25 * low[0] + 0.75 * high[0] else 1
        axes.annotate(
            name, (mark[0], mark[1]), textcoords="offset points", xytext=(5 * side, 5),
            ha="right" if side < 0 else "left",
        )  # fmt: skip
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="east, m", ylabel="north, m")
    axes.set_aspect("equal")
    # Below the map, which it would hide; a white line is seen on grey.
    figure.legend(loc="outside lower center", ncols=4, facecolor="0.7", framealpha=1.0)
    figure.savefig(path, dpi=110)


@dataclass(frozen=True)
class ErrorSeries:
    """One curve of `plot_errors`: time in s, error in what `panel` says, e.g. "3-D error, m"."""

    label: str
    time_s: Array
    error: Array
    panel: str


def plot_errors(
    path: Path,
    series: Sequence[ErrorSeries],
    shaded: Sequence[tuple[float, float, str]] = (),
    abscissa: str = "time, s",
) -> None:
    """Errors over time, one row per panel; `shaded` marks spans (begin, end, name).

    Each axis reaches as far as the errors in the spans: a start that was wrong outside of them
    would flatten all else. A label has the same colour in every panel; a curve is broken where its
    error is NaN.
    """
    panels = list(dict.fromkeys(s.panel for s in series))
    labels = list(dict.fromkeys(s.label for s in series))
    figure = Figure(figsize=(10, 2.6 * len(panels)), layout="constrained")
    for row, panel in enumerate(panels, start=1):
        axes = figure.add_subplot(len(panels), 1, row)
        for s in (s for s in series if s.panel == panel):
            colour = f"C{labels.index(s.label)}"
            # The dots show what stands alone between gaps, which a line would not.
            axes.plot(
                s.time_s, s.error, ".-", color=colour, label=s.label, linewidth=0.9, markersize=2.5
            )
        for begin, end, name in shaded:
            axes.axvspan(begin, end, color="tab:gray", alpha=0.15, label=name)
        axes.set(xlabel=abscissa, ylabel=panel)
        shown = [s for s in series if s.panel == panel]
        limit = _limit(shown, shaded)
        axes.set_ylim(0, limit)
        beyond = max(float(s.error[np.isfinite(s.error)].max(initial=0.0)) for s in shown)
        if limit is not None and beyond > limit:  # cut off, and not in silence
            text = f"outside the shaded span up to {beyond:.3g}"
            axes.set_title(text, loc="left", fontsize="small")
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize="small")
    figure.savefig(path, dpi=110)


def _limit(
    series: Sequence[ErrorSeries], spans: Sequence[tuple[float, float, str]]
) -> float | None:
    """Top of an axis: a little over the largest error within the spans; None leaves it open."""
    inside = [
        s.error[(s.time_s >= begin) & (s.time_s <= end)] for s in series for begin, end, _ in spans
    ]
    values = np.concatenate([*inside, np.empty(0)])
    largest = values[np.isfinite(values)].max(initial=0.0)
    return 1.15 * float(largest) if largest > 0 else None
