"""Focal length of a zoom camera from the zoom level that it reports.

CAMERA_SETTINGS (260) has `zoomLevel`, per cent of the range, and no focal length. A table of the
deployment gives the focal length; the logarithm of the factor is interpolated. The registration's
estimate corrects it slowly, within a bound.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from localizer.geometry.camera import Camera
from localizer.types import Frame, PoseEstimate
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import StrictModel

Level = Annotated[float, Field(ge=0.0, le=100.0)]
Factor = Annotated[float, Field(ge=0.2, le=50.0)]
_ALIKE = 1e-3  # a share of the focal length that is no other lens: below what a calibration knows
_ELSEWHERE = 0.05  # of the logarithm: so far off a table errs by something else
_ALIKE_PICTURES = 9.0
_REMEMBERED = 32  # pictures under way
_AGAIN_NS = 10_000_000_000  # the same trouble is reported so often


class ZoomTable(StrictModel):
    """Table of the focal length by zoom level."""

    points: tuple[tuple[Level, Factor], ...] = Field(
        min_length=2,
        description="CAMERA_SETTINGS level and focal length as a multiple of `model`'s",
    )
    hold_s: float = Field(2.0, exclude=True)  # validity of a report, s

    refine: float = Field(
        0.0,
        ge=0.0,
        le=0.02,
        description="largest correction of the table by the registration, as a share; 0: none",
    )

    @field_validator("points")
    @classmethod
    def _rise(cls, points: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for (level, factor), (later, longer) in pairwise(points):
            if later <= level or longer <= factor:
                raise ValueError(
                    f"[{later:g}, {longer:g}] after [{level:g}, {factor:g}]: levels and factors "
                    "both rise from point to point"
                )
        return points

    def factor(self, level: float) -> float | None:
        """Focal length at this level (0 to 100), as a multiple of the model's; None outside."""
        levels, factors = zip(*self.points, strict=True)
        if not levels[0] <= level <= levels[-1]:
            return None
        return math.exp(float(np.interp(level, levels, np.log(factors))))


def with_focal_factor(camera: Camera, factor: float) -> Camera:
    """The camera with its focal length times `factor`; principal point and distortion are
    unchanged.
    """
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


class FocalCorrection:
    """Estimates the zoom table's error, `value`: ln(true focal length / table's). bound: of its
    size, as a share. The sigma is half the bound at first; a zoom change widens it again, at most
    to that.
    """

    def __init__(self, bound: float) -> None:
        self._bound = math.log1p(bound)
        self._variance = self._first = (0.5 * self._bound) ** 2
        self.value = 0.0

    def zoom_changed(self, by: float) -> None:
        """Increase the sigma after a zoom change. by: change of ln(zoom factor)."""
        other = min(abs(by) / _ELSEWHERE, 1.0)
        self._variance = min(self._variance + other * self._first, self._first)

    def learn(self, seen: float, sigma: float) -> None:
        """Update with one frame. seen: measured ln(true focal length / table's); sigma: its 1
        sigma. The weight is reduced 9 times, because errors of consecutive frames are correlated.
        """
        noise = _ALIKE_PICTURES * sigma**2
        gain = self._variance / (self._variance + noise)
        self._variance *= 1.0 - gain
        value = self.value + gain * (seen - self.value)
        self.value = min(max(value, -self._bound), self._bound)


class ZoomedFrames:
    """Sets the camera model of each frame by its zoom, on the feed's thread; `learn` may be
    called from any thread.

    level_at(time_ns, hold_s): the zoom level (0 to 100) that the camera reported within hold_s of
    that time, None if unknown. report: receives an alert when a problem begins, and every ten
    seconds while it lasts.
    """

    def __init__(
        self,
        table: ZoomTable,
        level_at: Callable[[int, float], float | None],
        report: Callable[[Alert], None],
    ) -> None:
        self._table, self._level_at, self._report = table, level_at, report
        self._lock = threading.Lock()
        self._factor: float | None = None
        self._correction = FocalCorrection(table.refine)
        self._by_table: float | None = None  # the newest picture's factor
        self._assigned: deque[tuple[int, float, float]] = deque(maxlen=_REMEMBERED)
        self._reported_ns: int | None = None

    def __call__(self, frame: Frame) -> Frame | None:
        """The frame with its camera model. If the focal length is unknown, an alert is reported and
        None returned, because the fix would be wrong by metres and look as good as any.
        """
        level = self._level_at(frame.exposure_time_ns, self._table.hold_s)
        factor = None if level is None else self._table.factor(level)
        if factor is None:
            self._report_unknown(level, frame.exposure_time_ns)
            return None
        self._reported_ns = None
        with self._lock:
            if self._by_table is not None:
                self._correction.zoom_changed(math.log(factor / self._by_table))
            self._by_table = by_table = factor
            factor *= math.exp(self._correction.value)
            if self._factor is None or abs(factor / self._factor - 1.0) > _ALIKE:
                self._factor = factor
            factor = self._factor
            self._assigned.append((frame.exposure_time_ns, by_table, factor))
        return replace(frame, camera=with_focal_factor(frame.camera, factor))

    def learn(self, estimate: PoseEstimate) -> None:
        """Correct the table by a registered frame's focal length; any thread, never blocks. Ignored
        if the table's `refine` is 0, or the zoom has changed since.
        """
        fit = estimate.focal
        if fit is None or not self._table.refine:
            return
        with self._lock:
            for time_ns, by_table, factor in self._assigned:
                same = by_table == self._by_table  # of a lens that moved on it says nothing
                if time_ns == estimate.exposure_time_ns and same:
                    self._correction.learn(math.log(fit.factor * factor / by_table), fit.sigma)

    def _report_unknown(self, level: float | None, time_ns: int) -> None:
        if self._reported_ns is not None and 0 <= time_ns - self._reported_ns < _AGAIN_NS:
            return
        self._reported_ns = time_ns
        if level is None:
            self._report(alert(AlertId.ZOOM_UNKNOWN))
        else:
            self._report(alert(AlertId.ZOOM_NOT_IN_TABLE, level=level))
