"""Converts photo tags to poses, and poses to XMP sidecars.

Uses `companion.recorded.photo_tags`; a pose also needs all angles, and all heights above one
surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

from companion.convert.angles import gimbal_of_pose
from companion.errors import FootageError
from companion.recorded.flight import Datum
from companion.recorded.photo_tags import PhotoTags, read_photo_tags
from localizer.errors import GeoreferenceError, PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.geometry.trajectory import StampedPose
from localizer.plain_files import files_of

_PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg"})
_HOME_STEP_M = 15.0  # of absolute less relative height, which drift by metres
_NAMES = {Datum.ELLIPSOID: "ellipsoidal", Datum.AMSL: "amsl"}
_SIDECAR = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{attributes}/>
 </rdf:RDF>
</x:xmpmeta>
"""


@dataclass(frozen=True)
class Heights:
    """Datum of the heights in photo tags. separation_m: geoid above the ellipsoid."""

    datum: Literal["amsl", "ellipsoidal"]
    separation_m: float = 0.0

    @property
    def lift_m(self) -> float:
        """Metres to add to a tag's height to obtain the ellipsoidal height."""
        return self.separation_m if self.datum == "amsl" else 0.0


def read_photos(
    path: Path,
    frame: LocalFrame,
    heights: Heights | None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[StampedPose, ...]:
    """Poses of one photo or of a folder's photos and lone sidecars, by name. tell: receives
    warnings about the tags. `PoseFileError` if there is none, one lacks position, height or angles,
    or their heights have different datums; `GeoreferenceError` if `heights` is None.
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
    tags = {photo.name: _read_tags(photo) for photo in photos}
    _require_measured(path, tags)
    _require_one_datum(path, tags, tell)
    first = next(iter(tags.values()))
    stated = first.xmp.get("AltitudeType", "")
    if stated and first.altitude is not None and _NAMES[first.altitude.datum] != known.datum:
        datum = _NAMES[first.altitude.datum]
        tell(f"AltitudeType {stated}: such heights are {datum}, not {known.datum}")
    return tuple(_pose(one, frame, known.lift_m) for one in tags.values())


def _read_tags(path: Path) -> PhotoTags:
    try:
        return read_photo_tags(path)
    except FootageError as error:
        raise PoseFileError(str(error)) from error


def _require_measured(path: Path, photos: Mapping[str, PhotoTags]) -> None:
    """`PoseFileError` if all angles of a photo are 0.00: no gimbal is level and north to a
    hundredth of a degree.
    """
    zero = [name for name, tags in photos.items() if tags.has_zero_view]
    if zero:
        raise PoseFileError(
            f"{path}: the gimbal's angles are all 0 in {len(zero)} of {len(photos)} photos, first "
            f"{zero[0]}: this camera did not measure them; its direction must be given: by "
            "GimbalRollDegree, GimbalPitchDegree, GimbalYawDegree in NAME.xmp beside each photo, "
            "or by a pose file"
        )


def _require_one_datum(
    path: Path, photos: Mapping[str, PhotoTags], tell: Callable[[str], None]
) -> None:
    """`PoseFileError` if the tags state different datums for the heights of a flight."""
    kinds: dict[str, list[str]] = {}
    for name, tags in photos.items():
        if tags.altitude is not None:
            kinds.setdefault(tags.altitude.datum.value, []).append(name)
    if len(kinds) > 1:
        named = ", ".join(f"{kind}: {len(n)} photos, first {n[0]}" for kind, n in kinds.items())
        raise PoseFileError(
            f"{path}: the heights of these photos are above different surfaces ({named}), by their "
            "AltitudeType and RtkFlag; put each kind into a folder of its own and convert it with "
            "its --heights"
        )
    flags = sorted({f for t in photos.values() if (f := t.number("RtkFlag")) is not None})
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


def _home_m(tags: PhotoTags) -> float:
    """Height of the take-off point from the photo's tags, m; NaN if unknown."""
    height, above = tags.number("AbsoluteAltitude"), tags.number("RelativeAltitude")
    return float("nan") if height is None or above is None else height - above


def write_sidecars(
    folder: Path, poses: Sequence[StampedPose], frame: LocalFrame, heights: Heights | None
) -> None:
    """Write ``NAME.xmp`` with DJI's tags for each pose into the folder, which is created; older
    ones are replaced, photos are not changed. `GeoreferenceError` if `heights` is None; raises
    OSError.
    """
    lift = _known(folder, heights).lift_m
    folder.mkdir(parents=True, exist_ok=True)
    for pose in poses:
        position = frame.position(pose.world_from_camera.translation)
        roll, pitch, yaw = gimbal_of_pose(pose.world_from_camera, frame)
        tags = {
            "GpsLatitude": f"{position.latitude_deg:.9f}",
            "GpsLongitude": f"{position.longitude_deg:.9f}",
            "AbsoluteAltitude": f"{position.height_m - lift:+.4f}",
            "GimbalRollDegree": f"{roll:+.7f}",
            "GimbalPitchDegree": f"{pitch:+.7f}",
            "GimbalYawDegree": f"{yaw:+.7f}",
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


def _pose(tags: PhotoTags, frame: LocalFrame, lift_m: float) -> StampedPose:
    path = tags.path
    try:
        said = tags.telemetry()
        if said.view is None:
            raise ValueError("no gimbal angles in its XMP or NAME.xmp; which camera took it?")
        if tags.wrong_place is not None:
            raise ValueError(tags.wrong_place)
        if said.position is None or tags.altitude is None:
            raise ValueError("no GNSS fix, or only a height above take-off, in its tags; remove it")
        at = said.position
        height_m = tags.altitude.value_m + lift_m
        position = Geodetic(at.latitude_deg, at.longitude_deg, height_m)
    except (ValueError, GeoreferenceError) as error:
        raise PoseFileError(f"{path}: {error}") from error
    place = frame.enu_from_geodetic(at.latitude_deg, at.longitude_deg, height_m)
    rotation = frame.ned_from_enu(position).T @ said.view.ned_from_camera
    return StampedPose(path.name, Pose(rotation, place))
