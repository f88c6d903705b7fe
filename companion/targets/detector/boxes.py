"""Decodes a YOLO network's output to boxes, by the three layouts in which such networks come.

| layout | shape | a row |
|---|---|---|
| ``v5`` (YOLOv5, v7) | (1, N, 5 + C) | centre x, y, width, height, objectness, C class scores |
| ``v8`` (v8, v9, v11) | (1, 4 + C, N) | centre x, y, width, height, C class scores; a column each |
| ``end2end`` (v10, NMS in the graph) | (1, N, 6) | left, top, right, bottom, score, class |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import DetectorError

Layout = Literal["v5", "v8", "end2end"]
_STRIDES = (8, 16, 32)
_OVERLAP = 0.5  # intersection over union from which two boxes of a class are one thing
_MOST = 64  # boxes of a picture


@dataclass(frozen=True)
class Box:
    """A detected object. left to bottom: pixels of the network's input; label: class number."""

    left: float
    top: float
    right: float
    bottom: float
    score: float
    label: int


def layout_of(
    shape: tuple[int, ...], classes: int | None, size: tuple[int, int]
) -> tuple[Layout, int]:
    """(layout, number of classes) by the output's shape; `DetectorError` if it fits no layout, or
    two. classes: number of class names of the network; size: its input, width, height.
    """
    if len(shape) != 3 or shape[0] != 1:
        raise DetectorError(f"an output of shape {shape} is none of a YOLO network")
    cells = sum((size[0] // s) * (size[1] // s) for s in _STRIDES)
    _, a, b = shape
    fits: list[tuple[Layout, int]] = []
    if b > 5 and a == 3 * cells:
        fits.append(("v5", b - 5))
    if a > 4 and b == cells:
        fits.append(("v8", a - 4))
    if b == 6 and not fits:
        fits.append(("end2end", classes or 0))
    if classes is not None:
        fits = [fit for fit in fits if fit[1] == classes]
    if len(fits) != 1:
        names = ", ".join(get_args(Layout))
        raise DetectorError(
            f"an output of shape {shape} for images of {size[0]}x{size[1]}"
            + (f" and {classes} classes" if classes is not None else "")
            + f" fits {len(fits)} layouts: set targets.detector.layout to one of {names}"
        )
    return fits[0]


def decode(output: NDArray[np.float32], layout: Layout, threshold: float) -> list[Box]:
    """Boxes of at least the score `threshold`, best first, after non-maximum suppression; at most
    64. output: as of the layout; pixels of the network's input.
    """
    rows = output[0].T if layout == "v8" else output[0]
    if layout == "end2end":
        corners, scores, labels = rows[:, :4], rows[:, 4], rows[:, 5].astype(np.int64)
    else:
        each = rows[:, 4:] if layout == "v8" else rows[:, 4:5] * rows[:, 5:]
        labels, scores = each.argmax(axis=1), each.max(axis=1)
        half = rows[:, 2:4] / 2.0
        corners = np.hstack([rows[:, :2] - half, rows[:, :2] + half])
    good = (scores >= threshold) & np.isfinite(corners).all(axis=1)
    corners, scores, labels = corners[good], scores[good], labels[good]
    if layout == "end2end":
        kept = np.argsort(-scores)
    else:
        sides = np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
        kept = np.asarray(
            cv2.dnn.NMSBoxesBatched(
                sides.tolist(), scores.tolist(), labels.tolist(), threshold, _OVERLAP
            )
            if len(sides)
            else [],
            dtype=np.int64,
        ).ravel()
        kept = kept[np.argsort(-scores[kept])]
    found = []
    for k in kept[:_MOST]:
        left, top, right, bottom = (float(c) for c in corners[k])
        found.append(Box(left, top, right, bottom, float(scores[k]), int(labels[k])))
    return found
