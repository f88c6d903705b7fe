"""The active targets, each with one name and one track.

No thread and no clock; the time is that of the frames' exposure.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from companion.config import TargetConfig
from companion.targets.detections import GROUND_STATION, Detection, clicked_name, clicked_number
from companion.targets.pictures import RecentPictures
from localizer.geometry.pose import Array
from localizer.targets.follow import FollowedPosition, Gray, ImageFollower
from localizer.targets.limits import RefusalReason, SharedBias
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.targets.track import TargetSettings, TargetTrack, pixel_of
from localizer.types import PoseEstimate, TargetFix, Visibility
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name

_log = logging.getLogger(__name__)
_MAX_DETECTED = 32  # at a time: what a telemetry link bears
# A detected target unseen for so long makes room for another.
_GONE_NS = 10_000_000_000
_CONFIRMS_NS = 0.18e9
_PICTURES = 24  # kept, of accepted frames: longer than an operator's delay
_PICTURE_NS = 60_000_000  # between a click's frame and the picture that stands for it
_PASSED_NS = 450_000_000  # a picture so much earlier or later shows the ground that a car covers
_FOLLOWED_PX = 1.5
_STILL_M = 1.0  # around where a standing target is expected; nearer than this it has not left
_STANDS_M = 0.4
_NEAR_M = 1.5  # around where a moving one is, and three sigmas of its motion, at most so many:
_FAR_M = 15.0
_DEPARTS_S = 1.0  # after a click: so long it may be one that moves
_DEPARTED = 0.85  # correlation: what has just left looks as it did
_FASTEST_MPS = 25.0
_MISSED_S = 1.2  # a standing target that is not seen at its place for so long may have left it
_CHANGED_NS = 3_000_000_000
_LEAVES_IN, _LEAVES_OFF_M = 3, 1.0  # frames that show it go, and how far beside its way
_LEAVES_LEAST_MPS = 1.0
_LATE_S = 0.5  # so much earlier it may have been at its place than it was last found there
_LEFT, _LEAVES_MPS = 0.5, 5.0  # the chance that it left then, and how fast, axis by axis
_GROUND_EVERY = 3  # so many of the kept frames show the ground well enough
_LOST_S = 4.0
_SILENT_NS = 2_000_000_000  # what was told and is refused for so long is named,
_REPORT_AGAIN_NS = 10_000_000_000  # one of all targets in so long: a flood hides the others
_LONG_S = 0.6  # unseen for so long, it is believed to be back once it was seen to go on for
_BACK_S = (0.25, 1.0)  # so long, until its own motion has left a roof's edge behind
_BACK_GAP_S = 0.5
_BENDS = 0.4  # of its way: a bend behind the roof leads it so far aside of its last course
_PIXELS = 0.05  # of the picture's width: a delay's error beyond it is told as that much


_Picture = tuple[PoseEstimate, Gray]
"""The estimate of an accepted frame, and the frame in grey."""


def _off(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a - b))


@dataclass(frozen=True)
class Click:
    """A click of the operator. estimate: pose of the frame that was clicked; pixel: the clicked
    point (u, v); around: poses one sigma of the operator's delay before and after the frame, if
    known; extent: width and height of a clicked rectangle, pixels, None for a point; asked_by:
    `GROUND_STATION` or `CONSOLE`.
    """

    number: int
    estimate: PoseEstimate
    pixel: tuple[float, float]
    around: tuple[PoseEstimate, ...] = ()
    extent: tuple[float, float] | None = None
    asked_by: str = GROUND_STATION

    @property
    def name(self) -> str:
        """Name of the target that the click begins."""
        return clicked_name(self.number, self.asked_by)


@dataclass(frozen=True)
class TargetEstimate:
    """A target's position, and the pose estimate of the frame for which it is computed."""

    fix: TargetFix
    estimate: PoseEstimate


@dataclass
class _TargetState:
    track: TargetTrack
    reported_ns: int
    is_clicked: bool
    seen_ns: int
    """When it was last in the picture."""
    extent_m: tuple[float, float] | None = None
    follower: ImageFollower | None = None
    moved_at_once: bool = False
    """The pictures about the click's own show that it moves, or that a roof does beside it."""
    begun_ns: int = 0
    found_ns: int = 0
    """When it was last found in the image."""
    refusals: int = 0
    refused_ns: int = 0
    """Since when nothing but refusals came; 0 after a fix."""
    back: _Back | None = None
    unseen_ns: int = 0
    """Since when a standing one has not looked as it did, though nothing hides it; 0: it does."""
    changed_ns: int = 0
    """Since when it may have left, as the operator was told; 0: it has not."""
    is_slide_reported: bool = False
    leaving: tuple[tuple[int, Array], ...] = ()
    """When and where (3,) it seemed to have left its place, the newest few."""


@dataclass(frozen=True)
class _Back:
    """Where a target that was unseen for long may have reappeared. since_ns: when it was first seen
    there, at position (3,) m; time_ns: when last.
    """

    since_ns: int
    time_ns: int
    position: Array


class TargetManager:
    """The active targets, by name. Not thread-safe.

    on_target: receives each fix. on_gone: receives the name of each target that ended.
    report_alert: sends an alert to the operator. missed: number of detections without map under
    them: outside the frame, or in the sky; doubted: of detections whose position is too uncertain
    to be reported; refused: of detections of a 33rd target.

    Above 200 lines: a change of one target affects the others, so one class owns all.
    """

    def __init__(
        self,
        config: TargetConfig,
        cast: RayCaster,
        on_target: Callable[[TargetEstimate], None],
        on_gone: Callable[[str], None],
        report_alert: Callable[[Alert], None],
    ) -> None:
        self._config = config
        self._cast = cast
        self._on_target, self._on_gone, self._report_alert = on_target, on_gone, report_alert
        self._settings = TargetSettings(
            config.pixel_sigma,
            config.map_sigma_m,
            SharedBias(config.bias_sigma_m),
            config.max_sigma_m,
            outline_sigma_m=config.outline_sigma_m,
            confirm_s=config.confirm_s,
        )
        self._lives: dict[str, _TargetState] = {}
        self._pictures = RecentPictures[_Picture](_PICTURES, lambda picture: picture[1].nbytes)
        self._silence_reported_ns = -_REPORT_AGAIN_NS
        self.missed = 0
        self.doubted = 0
        self.refused = 0

    def begin(self, click: Click) -> None:
        """Start the target of a click and report its position. If there is none, an alert says why,
        and on_gone receives the name.
        """
        name, time_ns = click.name, click.estimate.exposure_time_ns
        track = TargetTrack(name, replace(self._settings, confirm_s=0.0), self._cast)
        fix = track.observe(click.estimate, click.pixel, drift=self._drift(click))
        if fix is None:
            self.missed += 1
            self._tell(AlertId.TARGET_REFUSED, name, why=Name(str(track.refusal)))
            self._on_gone(name)
            return
        life = _TargetState(track, time_ns, True, time_ns, found_ns=time_ns, begun_ns=time_ns)
        away = fix.position_world - click.estimate.world_from_camera.translation
        if click.extent is not None:
            cell = float(np.linalg.norm(away)) / click.estimate.camera.fx
            life.extent_m = (click.extent[0] * cell, click.extent[1] * cell)
        self._lives[name] = life
        sigma = float(np.sqrt(fix.covariance[0, 0] + fix.covariance[1, 1]))
        self._tell(AlertId.TARGET_FOUND, name, metres=sigma)
        self._report(life, fix, click.estimate)
        self._follow(name, life, click, fix)

    def add_detection(self, detection: Detection, estimate: PoseEstimate) -> None:
        """Update a target by a detection in the estimate's frame, and report its position; more
        than `rate_hz` detections a second are ignored.
        """
        name, time_ns = detection.target_id, estimate.exposure_time_ns
        life = self._lives.get(name)
        if life is not None and time_ns - life.seen_ns < self._period_ns(life):
            return
        if life is None and not self._has_room(time_ns):
            return  # before the work: a flood of names must cost next to nothing
        pixel, camera = (detection.u, detection.v), estimate.camera
        if not (0 <= pixel[0] <= camera.width and 0 <= pixel[1] <= camera.height):
            self.missed += 1
            return
        if life is None:
            track = TargetTrack(name, self._settings, self._cast)
            life = _TargetState(track, 0, False, time_ns)
        fix = life.track.observe(estimate, pixel)
        if _reason(life.track) is not RefusalReason.NO_MAP:
            self._lives[name] = life
        life.seen_ns = time_ns
        if fix is None:
            self._count_refusal(name, life, time_ns)
            return
        life.reported_ns, life.refused_ns = time_ns, 0
        self._report(life, fix, estimate)

    def add_image(self, estimate: PoseEstimate, gray: Gray) -> None:
        """Track each clicked target in the image of an accepted estimate: (H, W) uint8 grey."""
        self._pictures.append((estimate, gray))
        for name, life in [(n, x) for n, x in self._lives.items() if x.follower is not None]:
            self._look_for(name, life, (estimate, gray))

    def predict(self, estimate: PoseEstimate) -> None:
        """Report each clicked target at the estimate's frame, at most `rate_hz` times a second; end
        those that were outside the image for `timeout_s`.
        """
        for name, life in [(n, x) for n, x in self._lives.items() if x.is_clicked]:
            time_ns = estimate.exposure_time_ns
            if not self._is_due(life, time_ns):
                continue
            fix = life.track.hold(estimate)
            if fix is None:
                continue
            life.reported_ns = time_ns
            if life.changed_ns:
                fix = self._with_departure(life, fix, self._config.max_sigma_m)
            if fix.visibility is not Visibility.OUTSIDE:
                life.seen_ns = time_ns
            elif time_ns - life.seen_ns > self._config.timeout_s * 1e9:
                self._end_with(AlertId.TARGET_OUT_OF_VIEW, name)
                continue
            self._report(life, fix, estimate)

    def end(self, names: tuple[str, ...]) -> None:
        """End these targets; on_gone receives the names of those that were active."""
        for name in names:
            if self._lives.pop(name, None) is not None:
                self._on_gone(name)

    def _tell(self, of: AlertId, name: str, **values: Any) -> None:
        """Send an alert of a clicked target."""
        self._report_alert(alert(of, number=clicked_number(name) or 0, **values))

    def _end_with(self, of: AlertId, name: str, **values: Any) -> None:
        self._tell(of, name, **values)
        self.end((name,))

    def _follow(self, name: str, life: _TargetState, click: Click, fix: TargetFix) -> None:
        """Begin to track a clicked target in the image: from the clicked frame, if it is kept,
        through the newer ones, so that the operator's delay causes no error.
        """
        time_ns = click.estimate.exposure_time_ns
        kept = [p for p in self._pictures if abs(p[0].exposure_time_ns - time_ns) <= _PICTURE_NS]
        if not kept:
            return
        estimate, gray = min(kept, key=lambda p: abs(p[0].exposure_time_ns - time_ns))
        taken_ns = estimate.exposure_time_ns
        half_m = None if life.extent_m is None else 0.5 * max(life.extent_m)
        follower = ImageFollower(gray, estimate, fix.position_world, half_m)
        if not follower.ready:
            return
        others = [p for p in self._pictures if abs(p[0].exposure_time_ns - taken_ns) > _PASSED_NS]
        life.moved_at_once = follower.isolate(others)
        life.follower = follower
        for picture in [p for p in self._pictures if p[0].exposure_time_ns > taken_ns]:
            if name in self._lives:
                self._look_for(name, life, picture)

    def _look_for(self, name: str, life: _TargetState, picture: _Picture) -> None:
        """Find a target in an image; one that moves and is not found is predicted, then lost."""
        estimate, track, follower = picture[0], life.track, life.follower
        time_ns = estimate.exposure_time_ns
        expected = track.expected(time_ns)
        if follower is None or expected is None:
            return
        since_s = (time_ns - life.found_ns) * 1e-9
        if track.moves:
            found = self._find_moving(life, follower, picture)
        else:
            found = self._find_leaving(name, life, follower, picture, expected[0])
        fix = None
        if found is not None:
            fix = track.observe(estimate, found.pixel, pixel_sigma=_FOLLOWED_PX)
            life.found_ns = life.seen_ns = time_ns
            life.refused_ns = 0 if fix is not None else life.refused_ns or time_ns
        elif track.moves and since_s > _LOST_S and not self._may_be_back(life, time_ns):
            self._end_with(AlertId.TARGET_LOST, name)
            return
        elif track.moves:
            fix = track.coast(estimate)
        elif since_s > _MISSED_S and self._is_gone(name, life, follower, picture):
            return
        if fix is not None and self._is_due(life, time_ns):
            life.reported_ns = time_ns
            self._report(life, fix, estimate)
        if life.refused_ns and track.moves and time_ns - life.refused_ns > _LOST_S * 1e9:
            self._end_with(AlertId.TARGET_NOT_LOCATED, name, why=Name(str(track.refusal)))

    def _find_leaving(
        self, name: str, life: _TargetState, follower: ImageFollower, picture: _Picture,
        position: Array,
    ) -> FollowedPosition | None:  # fmt: skip
        """Find a target that was not measured to move yet, if it has left its place (3,); None if
        it is still there, or is not found.
        """
        estimate, gray = picture
        time_ns = estimate.exposure_time_ns
        left = self._find_departed_moving(life, follower, picture, position)
        if left is not None:
            return left if self._moves_steadily(life, left, position, time_ns) else None
        near = follower.find(gray, estimate, position, _STILL_M)
        is_over = time_ns - life.begun_ns > _DEPARTS_S * 1e9
        has_changed = follower.watch(gray, estimate, position)
        if near is None:
            left = self._find_departed(life, follower, picture, position)
            drives = left is not None and self._moves_steadily(life, left, position, time_ns)
            return left if drives else None
        if has_changed:
            return None
        if life.moved_at_once and not is_over and _off(near.position, position) >= _STANDS_M:
            return near
        # It stands, and geometry holds it better than its look, which slides with every change of
        # view on what is not flat. What moved between pictures has left its place by now: if it is
        # still here, a roof or a crown about it moved against the ground instead.
        self._note_in_place(name, life, time_ns)
        if life.moved_at_once and is_over:
            life.moved_at_once = False
            follower.forget_shape()
        return None

    def _is_gone(
        self, name: str, life: _TargetState, follower: ImageFollower, picture: _Picture
    ) -> bool:
        """Whether a target that was never measured to move ends, because the ground in its place is
        visible.

        If the target only looks different, the operator is told: after a sudden change it may have
        left.
        """
        estimate, gray = picture
        if life.moved_at_once and follower.shows_ground(gray, estimate):
            self._end_with(AlertId.TARGET_LEFT, name)
            return True
        held = life.track.hold(estimate)
        is_in_view = held is not None and held.visibility is Visibility.HELD
        life.unseen_ns = (life.unseen_ns or estimate.exposure_time_ns) if is_in_view else 0
        missed_ns = estimate.exposure_time_ns - life.unseen_ns if life.unseen_ns else 0
        if missed_ns <= _CHANGED_NS:
            return False
        if follower.is_changed and not life.changed_ns:
            life.changed_ns = life.found_ns
            self._tell(AlertId.TARGET_MAY_HAVE_LEFT, name)
        elif not life.is_slide_reported and not life.changed_ns:
            # The view of what is not flat changes by and by: its place is as good as before.
            life.is_slide_reported = True
            self._tell(AlertId.TARGET_HELD, name)
        return False

    @staticmethod
    def _moves_steadily(
        life: _TargetState, left: FollowedPosition, place: Array, time_ns: int
    ) -> bool:
        """Whether successive matches away from the target's place (3,) move at a constant speed.

        A match in a single frame may be a similar corner of a roof or line of a sports field.
        """
        kept = [seen for seen in life.leaving if time_ns - seen[0] <= _DEPARTS_S * 1e9]
        life.leaving = (*kept[1 - _LEAVES_IN :], (time_ns, left.position))
        if len(life.leaving) < _LEAVES_IN:
            return False
        times = np.array([(t - time_ns) * 1e-9 for t, _ in life.leaving])
        at = np.array([position for _, position in life.leaving])
        velocity = (at[-1] - at[0]) / (times[-1] - times[0])
        speed = float(np.linalg.norm(velocity))
        if speed < _LEAVES_LEAST_MPS:
            return False
        ahead = np.outer(times, velocity) + at[-1]
        since_s = float(np.clip((at[-1] - place) @ velocity / speed**2, 0.0, _DEPARTS_S + _LATE_S))
        off_m = [_off(a, b) for a, b in zip(at, ahead, strict=True)]
        return max(*off_m, _off(place, at[-1] - since_s * velocity)) <= _LEAVES_OFF_M

    def _note_in_place(self, name: str, life: _TargetState, time_ns: int) -> None:
        """Note that a target is at its place and looks as before."""
        life.found_ns, life.unseen_ns = time_ns, 0
        if life.changed_ns:
            life.changed_ns = 0
            self._tell(AlertId.TARGET_BACK, name)

    @staticmethod
    def _with_departure(life: _TargetState, fix: TargetFix, most_m: float) -> TargetFix:
        """The fix of a target that may have left its place: hidden, with the distance that it may
        have driven since in its sigma.
        """
        gone_s = (fix.exposure_time_ns - life.changed_ns) * 1e-9
        sigma_m = min(_LEAVES_MPS * gone_s, most_m)
        level = np.diag([1.0, 1.0, 0.0]) * _LEFT * sigma_m**2
        seen = Visibility.HIDDEN if fix.visibility is Visibility.HELD else fix.visibility
        return replace(fix, visibility=seen, covariance=fix.covariance + level)

    def _find_moving(
        self, life: _TargetState, follower: ImageFollower, picture: _Picture
    ) -> FollowedPosition | None:
        """Find a moving target near its predicted position; None if something hides it."""
        estimate, gray = picture
        time_ns = estimate.exposure_time_ns
        expected = life.track.expected(time_ns)
        if expected is None or life.track.is_being_hidden(estimate, expected[0]):
            return None  # what is seen there is what hides it
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(expected[1])[-1], 0.0)))
        reach_m = _NEAR_M + min(3.0 * sigma, _FAR_M)
        is_long = (time_ns - life.found_ns) * 1e-9 > _LONG_S
        can_tell, found = self._before_ground(
            follower, picture, expected[0], reach_m, was_hidden=is_long
        )
        if not can_tell:
            found = follower.find(gray, estimate, expected[0], reach_m, was_hidden=is_long)
        if found is not None and is_long and not self._is_back(life, found, time_ns):
            return None
        return found

    @staticmethod
    def _is_back(life: _TargetState, found: FollowedPosition, time_ns: int) -> bool:
        """Whether what was found moves on as the target did; a roof's edge does not."""
        back, velocity = life.back, life.track.velocity
        life.back = _Back(time_ns, time_ns, found.position)
        if back is None or velocity is None:
            return False
        since_s, speed = (time_ns - back.since_ns) * 1e-9, float(np.hypot(*velocity[:2]))
        gone = back.position + since_s * velocity
        is_gap = time_ns - back.time_ns > _BACK_GAP_S * 1e9
        aside_m = _STANDS_M + _BENDS * speed * since_s
        if is_gap or _off(found.position[:2], gone[:2]) > aside_m:
            return False
        life.back = replace(back, time_ns=time_ns)
        least_s = np.clip(2.0 * _STANDS_M / max(speed, 1e-3), *_BACK_S)
        return since_s >= float(least_s)

    @staticmethod
    def _may_be_back(life: _TargetState, time_ns: int) -> bool:
        """Whether a target that was unseen for long was found in the last 0.5 s."""
        back = life.back
        return back is not None and (time_ns - back.time_ns) * 1e-9 <= _BACK_GAP_S

    def _find_departed_moving(
        self, life: _TargetState, follower: ImageFollower, picture: _Picture, position: Array
    ) -> FollowedPosition | None:
        """Find a target that moved when it was clicked and now covers other ground; None if it
        stands.
        """
        since_s = (picture[0].exposure_time_ns - life.found_ns) * 1e-9
        if not life.moved_at_once or since_s > _DEPARTS_S:
            return None
        reach_m = _NEAR_M + _FASTEST_MPS * since_s
        _, found = self._before_ground(follower, picture, position, reach_m)
        return found if found is not None and _off(found.position, position) >= _STANDS_M else None

    def _before_ground(
        self, follower: ImageFollower, picture: _Picture, position: Array, reach_m: float,
        *, was_hidden: bool = False,
    ) -> tuple[bool, FollowedPosition | None]:  # fmt: skip
        """Whether earlier images can separate the target from the ground; where it is."""
        if not follower.is_isolated:
            return False, None
        estimate, gray = picture
        time_ns = estimate.exposure_time_ns
        before = [p for p in self._pictures if time_ns - p[0].exposure_time_ns > _PASSED_NS]
        ground = before[::_GROUND_EVERY]
        return follower.find_on_ground(
            gray, estimate, position, reach_m, ground, was_hidden=was_hidden
        )

    @staticmethod
    def _find_departed(
        life: _TargetState, follower: ImageFollower, picture: _Picture, position: Array
    ) -> FollowedPosition | None:
        """Find a clicked target that moves, before its motion was measured. The ground that it has
        left shows its shape. A car that only passes over a clicked place does not take the place's
        appearance along, so no match is found.
        """
        estimate, gray = picture
        since_s = (estimate.exposure_time_ns - life.found_ns) * 1e-9
        if since_s > _DEPARTS_S:
            return None
        if not follower.is_isolated and not follower.isolate((picture,)):
            return None
        found = follower.find(gray, estimate, position, _NEAR_M + _FASTEST_MPS * since_s)
        if found is not None and (life.moved_at_once or found.score >= _DEPARTED):
            return found
        if not life.moved_at_once:
            follower.forget_shape()
        return None

    def _report(self, life: _TargetState, fix: TargetFix, estimate: PoseEstimate) -> None:
        if life.extent_m is not None:
            away = fix.position_world - estimate.world_from_camera.translation
            scale = estimate.camera.fx / float(np.linalg.norm(away))
            extent = (life.extent_m[0] * scale, life.extent_m[1] * scale)
            fix = replace(fix, extent=extent)
        self._on_target(TargetEstimate(fix, estimate))

    def _is_due(self, life: _TargetState, time_ns: int) -> bool:
        return time_ns - life.reported_ns >= self._period_ns(life)

    def _period_ns(self, life: _TargetState) -> float:
        """Time between two reports; at most 0.2 s until the first one is confirmed."""
        # 0.9: frames do not fall on the period exactly.
        wanted = 0.9e9 / self._config.rate_hz
        return wanted if life.reported_ns else min(wanted, _CONFIRMS_NS)

    def _count_refusal(self, name: str, life: _TargetState, time_ns: int) -> None:
        """Count a detection that is not reported; alert if the target was reported before."""
        reason = _reason(life.track)
        if reason is RefusalReason.NO_MAP:
            self.missed += 1
        if reason in (RefusalReason.NO_MAP, RefusalReason.UNCONFIRMED):
            return
        self.doubted += 1
        life.refusals += 1
        if life.refusals == 1:
            _log.warning("target %s is not reported: %s", name, life.track.refusal)
        life.refused_ns = life.refused_ns or time_ns
        is_silent = life.reported_ns > 0 and time_ns - life.refused_ns >= _SILENT_NS
        if is_silent and time_ns - self._silence_reported_ns >= _REPORT_AGAIN_NS:
            self._silence_reported_ns = time_ns
            self._report_alert(
                alert(AlertId.TARGET_SILENT, name=Name(name), why=Name(str(life.track.refusal)))
            )

    def _drift(self, click: Click) -> tuple[float, float]:
        """Motion of the image in one sigma of the operator's delay, pixels (u, v)."""
        eye, d = ray_in_world(click.estimate, click.pixel)
        distance = float(self._cast(eye, d[None]).distances[0])
        if not np.isfinite(distance):
            return (0.0, 0.0)
        moved = [pixel_of(at, eye + distance * d) for at in click.around]
        most = _PIXELS * click.estimate.camera.width
        offsets = [np.array(p) - click.pixel if p is not None else np.full(2, most) for p in moved]
        if not offsets:
            return (0.0, 0.0)
        u, v = max(offsets, key=lambda o: float(o @ o))
        return float(u), float(v)

    def _has_room(self, now_ns: int) -> bool:
        """Whether one more target can be followed; ends those long unseen if necessary."""
        detected = {n: x for n, x in self._lives.items() if not x.is_clicked}
        if len(detected) < _MAX_DETECTED:
            return True
        gone = [n for n, life in detected.items() if now_ns - life.seen_ns > _GONE_NS]
        self.end(tuple(gone))
        if len(detected) - len(gone) < _MAX_DETECTED:
            return True
        self.refused += 1
        if self.refused == 1:
            _log.warning("more than %d targets at a time: the newest are left out", _MAX_DETECTED)
        return False


def _reason(track: TargetTrack) -> RefusalReason | None:
    """Why the last detection gave no fix; None if it gave one."""
    return None if track.refusal is None else track.refusal.reason
