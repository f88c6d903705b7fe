"""Poses in photo tags: EXIF's GPS position, DJI's gimbal angles in XMP; XMP sidecars.

XMP is in the JPEG (an APP1 segment) or beside it as NAME.xmp, which takes precedence. Gimbal
angles: roll, pitch (0 horizontal, -90 down), yaw clockwise from north, Rz(yaw) Ry(pitch) Rx(roll).
Impossible tags are ignored: angles that are all 0, position 0, 0, and heights with different
references in one flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from companion.convert.angles import Angles, gimbal_of_pose, pose_of_gimbal
from companion.errors import FootageError
from companion.recorded.photo_tags import read_photo_tags, read_xmp
from localizer.errors import GeoreferenceError, PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.trajectory import StampedPose
from localizer.plain_files import files_of

_PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg"})
_HOME_STEP_M = 15.0  # of absolute less relative height, which drift by metres
_RTK = {16, 34, 50}  # RtkFlag: single, float, fixed
_DATUMS = {"rtkalt": "ellipsoidal", "gpsfusionalt": "amsl"}  # of DJI's AltitudeType
_ANGLES = ("GimbalRollDegree", "GimbalPitchDegree", "GimbalYawDegree")
_SIDECAR = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{attributes}/>
 </rdf:RDF>
</x:xmpmeta>
"""


@dataclass(frozen=True)
class Heights:
    """Datum of the heights in photo tags. separation_m: of the geoid from the ellipsoid."""

    datum: Literal["amsl", "ellipsoidal"]
    separation_m: float = 0.0

    @property
    def lift_m(self) -> float:
        """Value to add to a tag's height to obtain the ellipsoidal height, m."""
        return self.separation_m if self.datum == "amsl" else 0.0


def read_photos(
    path: Path,
    frame: LocalFrame,
    heights: Heights | None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[StampedPose, ...]:
    """Poses of one photo or of a folder's photos, by name. tell: receives warnings about the tags.
    `PoseFileError` if there is no photo.
    """
    known = _known(path, heights)
    photos = [path]
    if path.is_dir():
        photos = files_of(path, _PHOTO_SUFFIXES)
        # Sidecars alone, as `write_sidecars` leaves them.
        stems = {p.stem for p in photos}
        photos += [p for p in files_of(path, (".xmp",)) if p.stem not in stems]
    if not photos:
        raise PoseFileError(f"{path}: holds no photo (.jpg, .jpeg) and no sidecar (.xmp)")
    tags = {photo.name: _xmp_tags(photo) for photo in photos}
    _require_measured(path, tags)
    _require_one_datum(path, tags, tell)
    stated = next(iter(tags.values())).get("AltitudeType", "")
    if _DATUMS.get(stated.lower(), known.datum) != known.datum:
        tell(
            f"AltitudeType {stated}: such heights are {_DATUMS[stated.lower()]}, not {known.datum}"
        )
    lift = known.lift_m
    return tuple(_read_photo(photo, tags[photo.name], frame, lift) for photo in photos)


def _require_measured(path: Path, photos: dict[str, dict[str, str]]) -> None:
    """Raise if all angles of a photo are 0.00: no gimbal is level and north to a hundredth of a
    degree.
    """
    zero = [
        name
        for name, tags in photos.items()
        if all(k in tags for k in _ANGLES) and not any(_number(tags, k) for k in _ANGLES)
    ]
    if zero:
        raise PoseFileError(
            f"{path}: the gimbal's angles are all 0 in {len(zero)} of {len(photos)} photos, first "
            f"{zero[0]}: this camera did not measure them; its direction must be given: by "
            f"{', '.join(_ANGLES)} in NAME.xmp beside each photo, or by a pose file"
        )


def _require_one_datum(
    path: Path, photos: dict[str, dict[str, str]], tell: Callable[[str], None]
) -> None:
    """All heights of a flight are above the same surface, as far as the tags say."""
    kinds: dict[str, list[str]] = {}
    for name, tags in photos.items():
        rtk = "with RTK" if _number(tags, "RtkFlag") in _RTK else "without RTK"
        kinds.setdefault(tags.get("AltitudeType", rtk), []).append(name)
    if len(kinds) > 1:
        named = ", ".join(f"{kind}: {len(n)} photos, first {n[0]}" for kind, n in kinds.items())
        raise PoseFileError(
            f"{path}: the heights of these photos are above different surfaces ({named}): RtkAlt "
            "is above the ellipsoid, GpsFusionAlt above the geoid; put each kind into a folder of "
            "its own and convert it with its --heights"
        )
    flags = sorted({f for t in photos.values() if (f := _number(t, "RtkFlag")) is not None})
    if len(flags) > 1:
        tell(
            f"RtkFlag {', '.join(f'{flag:.0f}' for flag in flags)}: not all photos have an RTK fix "
            "(50); the others' places may be metres off"
        )
    for (_, before), (name, tags) in pairwise(photos.items()):
        step = _home_m(tags) - _home_m(before)
        if abs(step) > _HOME_STEP_M:
            tell(
                f"{name}: AbsoluteAltitude less RelativeAltitude steps by {step:+.1f} m: the "
                "height's reference or another flight begins"
            )


def _home_m(tags: dict[str, str]) -> float:
    """Height of the take-off point from the photo's tags; NaN if unknown."""
    height, above = (_number(tags, f"{kind}Altitude") for kind in ("Absolute", "Relative"))
    return float("nan") if height is None or above is None else height - above


def _number(tags: dict[str, str], name: str) -> float | None:
    try:
        return float(tags[name])
    except (KeyError, ValueError):
        return None


def write_sidecars(
    folder: Path, poses: Sequence[StampedPose], frame: LocalFrame, heights: Heights | None
) -> None:
    """Write ``NAME.xmp`` with DJI's tags for each pose; photos are not changed."""
    lift = _known(folder, heights).lift_m
    folder.mkdir(parents=True, exist_ok=True)
    for pose in poses:
        position = frame.position(pose.world_from_camera.translation)
        gimbal = gimbal_of_pose(pose.world_from_camera, frame)
        tags = {
            "GpsLatitude": f"{position.latitude_deg:.9f}",
            "GpsLongitude": f"{position.longitude_deg:.9f}",
            "AbsoluteAltitude": f"{position.height_m - lift:+.4f}",
            "GimbalRollDegree": f"{gimbal.roll_deg:+.7f}",
            "GimbalPitchDegree": f"{gimbal.pitch_deg:+.7f}",
            "GimbalYawDegree": f"{gimbal.yaw_deg:+.7f}",
        }
        attributes = "\n".join(f'   drone-dji:{name}="{value}"' for name, value in tags.items())
        file = folder / Path(pose.name).with_suffix(".xmp").name
        file.write_text(_SIDECAR.format(attributes=attributes), encoding="utf-8")


def _known(path: Path, heights: Heights | None) -> Heights:
    if heights is None:
        raise GeoreferenceError(
            f"{path}: photos' tags do not say what their heights are above: give --heights amsl or "
            "ellipsoidal (RTK drones may write either; see the maker's manual)"
        )
    return heights


def _read_photo(path: Path, tags: dict[str, str], frame: LocalFrame, lift_m: float) -> StampedPose:
    missing = [name for name in _ANGLES if name not in tags]
    if missing:
        raise PoseFileError(f"{path}: its XMP lacks {', '.join(missing)}; which camera took it?")
    try:
        lat, lon, height = _xmp_position(tags) or _exif_position(path)
        angles = Angles(*(float(tags[name]) for name in _ANGLES))
        if not np.isfinite(angles.radians).all():
            raise ValueError("angles must be finite")
        if lat == lon == 0.0:
            raise ValueError("latitude and longitude are 0: it had no GNSS fix; remove the photo")
        position = Geodetic(lat, lon, height + lift_m)
    except (ValueError, GeoreferenceError) as error:
        raise PoseFileError(f"{path}: {error}") from error
    return StampedPose(path.name, pose_of_gimbal(position, angles, frame))


def _xmp_tags(path: Path) -> dict[str, str]:
    """DJI's tags by name: as attributes or as elements, both occur."""
    try:
        tags = read_xmp(path)
    except FootageError as error:
        raise PoseFileError(str(error)) from error
    if not tags:
        sidecar = path.with_suffix(".xmp").name
        raise PoseFileError(f"{path}: has no XMP tags, and there is no {sidecar}")
    return tags


def _xmp_position(tags: dict[str, str]) -> tuple[float, float, float] | None:
    """(latitude, longitude, height) of the tags; None where a part is missing."""
    # "GpsLongtitude" is how some of DJI's firmwares spell it.
    longitude = tags.get("GpsLongitude", tags.get("GpsLongtitude"))
    values = (tags.get("GpsLatitude"), longitude, tags.get("AbsoluteAltitude"))
    if any(value is None for value in values):
        return None
    lat, lon, height = (float(value) for value in values if value is not None)
    return lat, lon, height


def _exif_position(path: Path) -> tuple[float, float, float]:
    try:
        position = read_photo_tags(path).exif_position
    except FootageError as error:
        raise PoseFileError(str(error)) from error
    if position is None:
        raise PoseFileError(f"{path}: has no GPS position in EXIF or XMP")
    return position
