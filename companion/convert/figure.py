"""The figure of angles.md: ``python -m companion.convert.figure docs/img/angles.png``.

One camera, seen from above and from the side, with the angles that each convention gives it. Every
number in it is computed by the conversions themselves.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from companion.convert.angles import Angles, angles_of_matrix, gimbal_of_pose, pose_of_gimbal
from companion.geometry import GIMBAL_FROM_CAMERA
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose, matrix_from_euler
from localizer.geometry.posefile import pose_row

_PLACE = Geodetic(47.3, 8.5, 500.0)
_CAMERA = Angles(0.0, -40.0, 60.0)  # looks 60 degrees east of north, 40 below the horizon
_BODY = Angles(0.0, 0.0, 100.0)  # the vehicle's nose


@dataclass(frozen=True)
class _Ray:
    """A direction of a drawing: degrees, counter-clockwise from its right-hand axis."""

    degrees: float
    text: str
    colour: str = "black"


@dataclass(frozen=True)
class _Arc:
    """An angle: its text stands outside of the arc, or ends at `beside` where that is crowded."""

    text: str
    radius: float = 0.55
    beside: tuple[float, float] | None = None


_NORTH, _HORIZON, _NADIR = 90.0, 0.0, -90.0
_NOSE, _HEADING, _SIGHT = 90.0 - _BODY.yaw_deg, 90.0 - _CAMERA.yaw_deg, _CAMERA.pitch_deg


def draw(path: Path) -> None:
    """Two drawings a convention, from above and from the side."""
    pose = pose_of_gimbal(_PLACE, _CAMERA, LocalFrame(_PLACE))
    figure = Figure(figsize=(13, 6.2), layout="constrained")
    axes = figure.subplots(2, 4)
    columns = (_pose_line, _camera_axes, _autopilot, _photo)
    for column, above, side in zip(columns, axes[0], axes[1], strict=True):
        for drawing, caption in ((above, "from above"), (side, "from the side")):
            drawing.set(xlim=(-0.9, 1.7), ylim=(-1.3, 1.3), aspect="equal", xticks=[], yticks=[])
            drawing.text(-0.85, -1.23, caption, fontsize=8, color="gray")
        above.set_title(column(above, side, pose), fontsize=10)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def _camera(degrees: float) -> _Ray:
    return _Ray(degrees, "camera", "tab:red")


def _pose_line(above: Any, side: Any, pose: Pose) -> str:
    row = pose_row("", pose, LocalFrame(_PLACE))
    _angle(above, _Ray(_NORTH, "north: 0"), _camera(_HEADING), _Arc(f"yaw {row.yaw_deg:+.0f}"))
    pitch = _Arc(f"pitch {row.pitch_deg:+.0f}", beside=(-0.08, -0.5))
    _angle(side, _Ray(_NADIR, "nadir: 0"), _camera(_SIGHT), pitch)
    angles = f"roll {row.roll_deg:.0f}, pitch {row.pitch_deg:.0f}, yaw {row.yaw_deg:.0f}"
    return f"PiLoT pose line\n{angles}"


def _autopilot(above: Any, side: Any, pose: Pose) -> str:
    body = matrix_from_euler(*_BODY.radians)
    # The body is level: its own axes are those of its heading.
    gimbal = angles_of_matrix(body.T @ NED_FROM_ENU @ pose.rotation @ GIMBAL_FROM_CAMERA.T)
    nose, yaw = (
        _Ray(_NOSE, "nose", "tab:blue"),
        _Arc(f"body\nyaw {_BODY.yaw_deg:+.0f}", 0.4, (-0.08, 0.4)),
    )
    _angle(above, _Ray(_NORTH, "north: 0"), nose, yaw)
    _angle(
        above, _Ray(_NOSE, ""), _camera(_HEADING), _Arc(f"gimbal yaw {gimbal.yaw_deg:+.0f}", 0.6)
    )
    pitch = _Arc(f"gimbal pitch {gimbal.pitch_deg:+.0f}")
    _angle(side, _Ray(_HORIZON, "horizon: 0"), _camera(_SIGHT), pitch)
    angles = f"gimbal {abs(gimbal.roll_deg):.0f} {gimbal.pitch_deg:.0f} {gimbal.yaw_deg:.0f}"
    return f"Autopilot: body FRD in NED, gimbal\nbody 0 0 {_BODY.yaw_deg:.0f}, {angles}"


def _photo(above: Any, side: Any, pose: Pose) -> str:
    gimbal = gimbal_of_pose(pose, LocalFrame(_PLACE))
    yaw, pitch = _Arc(f"yaw {gimbal.yaw_deg:+.0f}"), _Arc(f"pitch {gimbal.pitch_deg:+.0f}")
    _angle(above, _Ray(_NORTH, "north: 0"), _camera(_HEADING), yaw)
    _angle(side, _Ray(_HORIZON, "horizon: 0"), _camera(_SIGHT), pitch)
    angles = f"Roll {gimbal.roll_deg:.0f}, Pitch {gimbal.pitch_deg:.0f}, Yaw {gimbal.yaw_deg:.0f}"
    return f"XMP of a photo (DJI)\nGimbal {angles}"


def _angle(axes: Any, zero: _Ray, turned: _Ray, arc: _Arc) -> None:
    """An arc from the direction that counts as zero to another one, with an arrow at its end."""
    if zero.text:
        _ray(axes, _Ray(zero.degrees, zero.text, "gray"), "--")
    _ray(axes, turned)
    low, high = sorted((zero.degrees, turned.degrees))
    size, colour = 2 * arc.radius, turned.colour
    axes.add_patch(Arc((0, 0), size, size, theta1=low, theta2=high, color=colour))
    last = np.sign(turned.degrees - zero.degrees) * 6.0
    axes.annotate(
        "",
        _at(turned.degrees, arc.radius),
        _at(turned.degrees - last, arc.radius),
        arrowprops={"arrowstyle": "->", "color": colour},
    )
    middle = zero.degrees + 0.4 * (turned.degrees - zero.degrees)
    place = arc.beside or _at(middle, arc.radius + 0.2)
    align = "right" if arc.beside else "left"
    axes.text(*place, arc.text, color=colour, fontsize=9, ha=align, va="center")


def _ray(axes: Any, ray: _Ray, style: str = "-") -> None:
    x, y = _at(ray.degrees, 1.0)
    axes.plot([0, x], [0, y], style, color=ray.colour)
    side = "left" if x > 0.3 else "center"
    axes.text(1.06 * x, 1.06 * y, ray.text, color=ray.colour, fontsize=9, ha=side, va="center")


def _at(degrees: float, radius: float) -> tuple[float, float]:
    return float(radius * np.cos(np.radians(degrees))), float(radius * np.sin(np.radians(degrees)))


def _camera_axes(above: Any, side: Any, pose: Pose) -> str:
    """The columns of world_from_camera's rotation: x, y and z of the camera in east, north, up."""
    heading = np.radians(90.0 - _CAMERA.yaw_deg)
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])  # level, along the line of sight
    for k, (name, colour) in enumerate((("x", "tab:red"), ("y", "tab:green"), ("z", "tab:blue"))):
        axis: Array = pose.rotation[:, k]
        for drawing, tip in ((above, axis[:2]), (side, np.array([axis @ forward, axis[2]]))):
            if np.linalg.norm(tip) < 0.05:
                drawing.text(0.06, 0.08, f"{name} towards you", color=colour, fontsize=9)
                continue
            drawing.annotate(
                "", tip, (0, 0), arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.5}
            )
            drawing.text(*(1.12 * tip), name, color=colour, fontsize=10, ha="center")
    return "OpenCV camera: no angles\nx right, y down, z forward"


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
