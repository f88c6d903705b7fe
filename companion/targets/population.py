"""All targets that are alive: each has one identity, one track and one end.

No thread and no clock: what time it is, the frames' exposures say.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.config import TargetConfig
from companion.targets.detections import CLICKED, Detection
from localizer.geometry.pose import Array
from localizer.targets.bias import SharedBias
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.targets.track import TargetSettings, TargetTrack, projected
from localizer.types import PoseEstimate, TargetFix, Visibility

_log = logging.getLogger(__name__)
_MAX_DETECTED = 32  # at a time: what a telemetry link bears
# A detected target unseen for so long makes room for another.
_GONE_NS = 10_000_000_000
_WARNING, _INFO = 4, 6  # MAV_SEVERITY
_PIXELS = 0.05  # of the picture's width: a delay's error beyond it is told as that much


def clicked_name(number: int) -> str:
    """What the target of the click with that number is called."""
    return f"{CLICKED}{number}"


@dataclass(frozen=True)
class Click:
    """What the operator pointed at. estimate: of the frame that he saw; pixel: in it; around: the
    estimates one sigma of his delay before and after it, where they are known; extent: width and
    height of his rectangle, pixels.
    """

    number: int
    estimate: PoseEstimate
    pixel: tuple[float, float]
    around: tuple[PoseEstimate, ...] = ()
    extent: tuple[float, float] | None = None


@dataclass(frozen=True)
class Target:
    """A target's fix, and the estimate of the frame that it is told for."""

    fix: TargetFix
    estimate: PoseEstimate

    @property
    def velocity(self) -> Array | None:
        """(3,) m/s, world axes; None of what stands or was located once."""
        return self.fix.velocity


@dataclass
class _Life:
    track: TargetTrack
    told_ns: int
    is_clicked: bool
    seen_ns: int
    """When it was last in the picture."""
    extent: tuple[float, float] | None = None
    refusals: int = 0


class Population:
    """The living targets, by name. Not thread-safe.

    tell: takes each fix. gone: takes the name of each target that ended. say: tells the operator
    (MAV_SEVERITY, text). missed counts detections that show no map: beside the picture, or in the
    sky; doubted those whose place may not be told; refused those of targets beyond the 32nd.
    """

    def __init__(
        self,
        config: TargetConfig,
        cast: RayCaster,
        tell: Callable[[Target], None],
        gone: Callable[[str], None],
        say: Callable[[int, str], None],
    ) -> None:
        self._config = config
        self._cast = cast
        self._tell, self._gone, self._say = tell, gone, say
        self._settings = TargetSettings(
            config.pixel_sigma,
            config.map_sigma_m,
            SharedBias(config.bias_sigma_m),
            config.max_sigma_m,
        )
        self._lives: dict[str, _Life] = {}
        self.missed = 0
        self.doubted = 0
        self.refused = 0

    def begin(self, click: Click) -> None:
        """A clicked target begins; the operator is told where it is, or why it is not."""
        name, time_ns = clicked_name(click.number), click.estimate.exposure_time_ns
        track = TargetTrack(name, self._settings, self._cast)
        fix = track.see(click.estimate, click.pixel, drift=self._drift(click))
        if fix is None:
            self.missed += 1
            self._say(_WARNING, f"PiLoT: target {click.number} refused: {track.refusal}")
            self._gone(name)
            return
        life = _Life(track, time_ns, True, time_ns, click.extent)
        self._lives[name] = life
        sigma = float(np.sqrt(fix.covariance[0, 0] + fix.covariance[1, 1]))
        self._say(_INFO, f"PiLoT: target {click.number}: +-{sigma:.1f} m")
        self._report(life, fix, click.estimate)

    def see(self, detection: Detection, estimate: PoseEstimate) -> None:
        """A detection in its frame, at most `rate_hz` times a second."""
        name, time_ns = detection.target_id, estimate.exposure_time_ns
        life = self._lives.get(name)
        if life is not None and not self._is_due(life, time_ns):
            return
        if life is None and not self._has_room(time_ns):
            return  # before the work: a flood of names must cost next to nothing
        pixel, camera = (detection.u, detection.v), estimate.camera
        if not (0 <= pixel[0] <= camera.width and 0 <= pixel[1] <= camera.height):
            self.missed += 1
            return
        if life is None:
            track = TargetTrack(name, self._settings, self._cast)
            life = _Life(track, time_ns, False, time_ns)
        fix = life.track.see(estimate, pixel)
        if fix is None:
            self._doubt(name, life)
            return
        self._lives[name] = life
        life.told_ns = life.seen_ns = time_ns
        self._report(life, fix, estimate)

    def hold(self, estimate: PoseEstimate) -> None:
        """Every clicked target as a newer frame shows it; those out of sight too long end."""
        for name, life in [(n, x) for n, x in self._lives.items() if x.is_clicked]:
            time_ns = estimate.exposure_time_ns
            if not self._is_due(life, time_ns):
                continue
            fix = life.track.hold(estimate)
            if fix is None:
                continue
            life.told_ns = time_ns
            if fix.visibility is not Visibility.OUTSIDE:
                life.seen_ns = time_ns
            elif time_ns - life.seen_ns > self._config.timeout_s * 1e9:
                self._say(_INFO, f"PiLoT: target {name[len(CLICKED) :]} ended: out of the picture")
                self.end((name,))
                continue
            self._report(life, fix, estimate)

    def end(self, names: tuple[str, ...]) -> None:
        """End these targets; their names are told, if they were alive."""
        for name in names:
            if self._lives.pop(name, None) is not None:
                self._gone(name)

    def _report(self, life: _Life, fix: TargetFix, estimate: PoseEstimate) -> None:
        self._tell(Target(fix, estimate))

    def _is_due(self, life: _Life, time_ns: int) -> bool:
        # 0.9: frames do not fall on the period exactly.
        return time_ns - life.told_ns >= 0.9e9 / self._config.rate_hz

    def _doubt(self, name: str, life: _Life) -> None:
        """Count what is not told, and why."""
        if life.track.refusal == "no map under it":
            self.missed += 1
            return
        self.doubted += 1
        life.refusals += 1
        if life.refusals == 1:
            _log.warning("target %s is not told: %s", name, life.track.refusal)

    def _drift(self, click: Click) -> tuple[float, float]:
        """One sigma, in pixels, of the picture's motion within the delay's error."""
        eye, d = ray_in_world(click.estimate, click.pixel)
        distance = float(self._cast(eye, d[None]).distances[0])
        if not np.isfinite(distance):
            return (0.0, 0.0)
        moved = [projected(at, eye + distance * d) for at in click.around]
        most = _PIXELS * click.estimate.camera.width
        offsets = [np.array(p) - click.pixel if p is not None else np.full(2, most) for p in moved]
        if not offsets:
            return (0.0, 0.0)
        u, v = max(offsets, key=lambda o: float(o @ o))
        return float(u), float(v)

    def _has_room(self, now_ns: int) -> bool:
        """Whether one more target can be followed, once those that are gone are forgotten."""
        detected = {n: x for n, x in self._lives.items() if not x.is_clicked}
        if len(detected) < _MAX_DETECTED:
            return True
        gone = [n for n, life in detected.items() if now_ns - life.told_ns > _GONE_NS]
        self.end(tuple(gone))
        if len(detected) - len(gone) < _MAX_DETECTED:
            return True
        self.refused += 1
        if self.refused == 1:
            _log.warning("more than %d targets at a time: the newest are left out", _MAX_DETECTED)
        return False
