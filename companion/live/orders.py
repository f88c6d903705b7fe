"""Executes the orders that the console sends (targets, position hints), in the flight process."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from companion.errors import CompanionError
from companion.targets.detections import CONSOLE
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, reason
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import TrackRequest

_MOST = 10  # orders in as many seconds
_SPAN_S = 5.0
_LARGEST_RADIUS_M = 10_000.0
_OLDEST_S, _AHEAD_S = 10.0, 1.0  # of a picture that is pointed into


class OrderError(CompanionError):
    """The reason why an order is not executed."""


@dataclass(frozen=True)
class OrderContext:
    """Functions that orders call. report: alert to operator and log; track: start or stop a target,
    with the exposure time of the clicked frame; hint: search at (latitude_deg, longitude_deg,
    radius_m); raises `OrderError` for a position off the map.
    """

    report: Callable[[Alert], None]
    track: Callable[[TrackRequest], None]
    hint: Callable[[float, float, float], None]


class Orders:
    """Checks, executes and reports the console's orders. control: whether orders are allowed."""

    def __init__(
        self, control: bool, context: OrderContext, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._control, self._helm, self._clock = control, context, clock
        self._taken: deque[float] = deque(maxlen=_MOST)

    def execute(self, order: dict[str, Any]) -> str:
        """Execute an order and report it; returns a text for the page. Raises `OrderError` with the
        reason, also for more than 10 orders in 5 s.
        order: JSON object; its "do" is "stop", "target" (with x, y), "box" (left, top, right,
        bottom) or "hint" (latitude_deg, longitude_deg, radius_m). Pixels are shares of the image, 0
        to 1; "exposure_ns" names their frame.
        """
        if not self._control:
            raise OrderError("the console only reads: console.control is false")
        now = self._clock()
        if len(self._taken) == _MOST and now - self._taken[0] < _SPAN_S:
            raise OrderError(f"more than {_MOST} orders in {_SPAN_S:.0f} s")
        self._taken.append(now)
        do = order.get("do")
        if do == "stop":
            return self._track("stop", order, (), alert(AlertId.CONSOLE_STOP))
        if do == "target":
            x, y = (_number_to_one(order, key) for key in ("x", "y"))
            return self._track("point", order, (x, y), alert(AlertId.CONSOLE_TARGET, x=x, y=y))
        if do == "box":
            box = tuple(_number_to_one(order, key) for key in ("left", "top", "right", "bottom"))
            if box[0] >= box[2] or box[1] >= box[3]:
                raise OrderError("a box has its left top before its right bottom")
            news = alert(AlertId.CONSOLE_BOX, x=box[0], y=box[1])
            return self._track("rectangle", order, box, news)
        if do == "hint":
            latitude = _number(order, "latitude_deg", -90.0, 90.0)
            longitude = _number(order, "longitude_deg", -180.0, 180.0)
            radius = _number(order, "radius_m", 5.0, _LARGEST_RADIUS_M)
            self._helm.hint(latitude, longitude, radius)
            return self._report(
                alert(AlertId.CONSOLE_HINT, latitude=latitude, longitude=longitude, metres=radius)
            )
        raise OrderError("no such order")

    def _track(self, kind: str, order: dict[str, Any], at: tuple[float, ...], news: Alert) -> str:
        time_ns = time.monotonic_ns() if kind == "stop" else _click_time_ns(order)
        self._helm.track(TrackRequest(kind, time_ns, at, asked_by=CONSOLE))
        return self._report(news)

    def _report(self, news: Alert) -> str:
        self._helm.report(news)
        return reason(news)


def _click_time_ns(order: dict[str, Any]) -> int:
    """Exposure time of the clicked frame; now if the order does not state it. `OrderError` if it is
    over 10 s old or of another flight, because the pixel shows another place in the present frame.
    """
    now_ns = time.monotonic_ns()
    if order.get("exposure_ns") is None:
        return now_ns
    age_s = (now_ns - _number(order, "exposure_ns", 0.0, 2.0**63)) * 1e-9
    if not -_AHEAD_S <= age_s < _OLDEST_S:
        raise OrderError("the clicked frame is too old: click into a newer one")
    return min(int(order["exposure_ns"]), now_ns)


def _number_to_one(order: dict[str, Any], key: str) -> float:
    return _number(order, key, 0.0, 1.0)


def _number(order: dict[str, Any], key: str, low: float, high: float) -> float:
    value = order.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise OrderError(f"{key} is a number")
    if not low <= value <= high:  # false for NaN, too
        raise OrderError(f"{key} is {low:g} to {high:g}")
    return float(value)
