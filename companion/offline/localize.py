"""Localizes images without their true poses: photos with priors, or a video's frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.errors import StreamDecodeError, StreamSizeError
from companion.recorded.flight import RecordedFrame
from companion.sources.folder_source import exposure_times_of
from localizer.config import LocalizerConfig
from localizer.errors import OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.pipeline import Localizer
from localizer.types import PoseEstimate, PosePrior, RegistrationStatus

_PASSES = 3  # of an image that starts from a prior: the view from there shows another place


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of priors per axis. attitude_deg, height_m: of measured roll and pitch,
    and of a measured height; None: the values are only used as start values.
    """

    position_m: float
    rotation_deg: float
    attitude_deg: float | None = None
    height_m: float | None = None

    def config(self, config: LocalizerConfig) -> LocalizerConfig:
        """A copy of the localizer's settings with the sigmas of these sensors."""
        known = None if self.attitude_deg is None else AttitudePrior.with_sigma(self.attitude_deg)
        return config.model_copy(update={"attitude": known, "height_sigma_m": self.height_m})


def sensors_of(poses: Mapping[int, Pose]) -> AuxiliarySensors:
    """Attitude and height of poses as simulated sensor measurements; None at other times. Keys:
    image time, ns.
    """

    def rotation_at(time_ns: int) -> Array | None:
        return poses[time_ns].rotation if time_ns in poses else None

    def height_at(time_ns: int) -> float | None:
        return float(poses[time_ns].translation[2]) if time_ns in poses else None

    return AuxiliarySensors(rotation_at=rotation_at, height_at=height_at)


@dataclass(frozen=True)
class LocalizedImage:
    """Result of one image. estimate: None if there is none; then `problem` says why."""

    name: str
    estimate: PoseEstimate | None
    problem: str = ""


def image_times(images: Sequence[Path], rate_hz: float) -> tuple[int, ...]:
    """Exposure times in ns of images (at least one) in one folder, from its ``timestamps.txt``,
    else at `rate_hz`. `StreamOpenError` if the file lacks one.
    """
    times = exposure_times_of(images[0].parent, images)
    return times or tuple(round((k + 1) * 1e9 / rate_hz) for k in range(len(images)))


def localize_images(
    localizer: Localizer,
    images: Sequence[Path],
    times_ns: Sequence[int],
    camera: Camera,
    priors: Mapping[str, Pose],
    sigmas: Sigmas,
) -> Iterator[LocalizedImage]:
    """Yield the result of each image in order.

    An image named in `priors` starts from its own prior. The others continue from the image before,
    as frames of a video. An image that cannot be used, or that is outside the map, is reported and
    left out.
    """
    for sequence, (path, time_ns) in enumerate(zip(images, times_ns, strict=True)):
        prior = priors.get(path.name)
        if prior is not None:
            around = PosePrior.around(prior, sigmas.position_m, sigmas.rotation_deg, time_ns)
            localizer.set_prior(around)
        try:
            frame = RecordedFrame(path.name, path, time_ns).load(camera, time_ns, sequence)
            estimate = localizer.track(frame, passes=1 if prior is None else _PASSES)
        except (OutsideMapError, StreamDecodeError, StreamSizeError) as error:
            # The caller names the image, too.
            text = str(error).removeprefix(f"{path}: ").removeprefix(f"{path.name}: ")
            yield LocalizedImage(path.name, None, text)
            continue
        problem = "" if estimate.accepted else f"not localized: {_why(estimate)}"
        yield LocalizedImage(path.name, estimate, problem)


def _why(estimate: PoseEstimate) -> str:
    if estimate.status is RegistrationStatus.OK:
        return (
            "registered, but rejected: image and map agree too little "
            f"(quality {estimate.quality:.2f}); check the prior, or say by --prior-sigma-m how far "
            "it may be off"
        )
    return f"{estimate.status.value}, quality {estimate.quality:.2f}"
