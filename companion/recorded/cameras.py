"""Camera models from photo tags or files, with the uncertainty of the focal length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from companion.config import CameraModel, of_stream_size
from companion.errors import FootageError
from companion.recorded.flight import CameraGuess
from companion.recorded.photo_tags import PhotoTags
from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.geometry.camera_file import camera_numbers, read_numbers

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)  # the 35 mm equivalent compares diagonals (CIPA DCG-001)
_NATIVE_ASPECT = 4.0 / 3.0  # of nearly all sensors in drones; 16:9 and 3:2 are cut out of them
_SMALL_SENSOR_MM = 12.0  # focal lengths below it belong to such sensors
_FACTORY, _NOMINAL, _ROUNDED = 0.3, 1.0, 2.0  # per cent, 1 sigma
_GIVEN = 3.0  # of a camera file of which nobody says how it was made

# Width of the whole sensor, mm, by the model's EXIF name: from the makers' data sheets.
_SENSOR_WIDTH_MM: Mapping[str, float] = {
    "FC300X": 6.17, "FC300S": 6.17, "FC330": 6.17, "FC220": 6.17, "FC6310": 13.2, "FC6310S": 13.2,
    "FC6310R": 13.2, "L1D-20C": 13.2, "FC3411": 13.2, "FC6520": 17.3, "FC550": 17.3,
    "ZENMUSEP1": 35.9, "EP800": 13.2, "S.O.D.A.": 13.2, "ANAFI": 5.9, "XT701": 6.4, "XT705": 13.2,
}  # fmt: skip


def camera_of_tags(tags: PhotoTags) -> CameraGuess:
    """Camera model of a photo at its present size, from its most accurate tag: the maker's
    calibration first, the 35 mm equivalent last. `FootageError` if no tag gives a possible lens.
    """
    for guess in (_dewarp, _calibrated, _perspective, _by_sensor, _equivalent):
        try:
            found = guess(tags)
            if found is not None:
                CameraModel(**of_stream_size(found.camera).to_dict())
                return found
        except (CameraError, ValueError):  # nan, or no lens: the next tag may hold
            continue
    raise FootageError(
        f"{tags.path}: no tag says the focal length; give the camera's model as --camera FILE or "
        "its horizontal field of view as --fov DEGREES"
    )


def camera_given(camera: Camera, source: str) -> CameraGuess:
    """A camera model that the user gives, focal sigma 3 %. source: its origin, for the report."""
    return CameraGuess(camera, _GIVEN, source)


def camera_of_file(path: Path) -> CameraGuess:
    """Read a camera model from a file. A distortion that folds the image corners, and is otherwise
    smaller than the focal length's sigma, is dropped as overfitted. `CameraError` for others.
    """
    try:
        return camera_given(Camera.from_json(path), path.name)
    except CameraError as error:
        try:
            camera = Camera(**camera_numbers(read_numbers(path)))
        except (CameraError, ValueError, TypeError, OverflowError):
            raise error from None
        reach = 0.5 * min(camera.width / camera.fx, camera.height / camera.fy)
        r = np.linspace(0.1, 1.0, 10) * reach
        if not np.abs(camera.distorted(r, np.zeros(10))[0] / r - 1.0).max() <= 0.01 * _GIVEN:
            raise
        source = f"{path.name} without its distortion, which cannot be undone in the corners"
        return camera_given(camera.without_distortion(), source)


def equivalent_camera(width: int, height: int, focal_35mm: float, *, small: bool) -> Camera:
    """Pinhole camera of a 35 mm equivalent focal length (mm). small: the sensor has 4:3; a wider
    image shows its full width.
    """
    aspect = min(width / height, _NATIVE_ASPECT) if small else width / height
    diagonal = math.hypot(width, width / aspect)
    return _pinhole(width, height, focal_35mm / _FILM_DIAGONAL_MM * diagonal)


def _pinhole(width: int, height: int, focal_px: float) -> Camera:
    return Camera(width, height, focal_px, focal_px, width / 2, height / 2)


def _dewarp(tags: PhotoTags) -> CameraGuess | None:
    """DJI's DewarpData: ``date;fx,fy,cx,cy,k1,k2,p1,p2,k3``, the centre from the image's middle."""
    numbers = tags.xmp.get("DewarpData", "").rpartition(";")[2].split(",")
    try:
        values = [float(x) for x in numbers]
    except ValueError:
        return None
    if len(values) != 9 or values[0] <= 0.0:
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    width, height = _taken_size(tags)
    camera = Camera(
        width, height, fx, fy, width / 2 + cx, height / 2 + cy, (k1, k2, p1, p2, k3)
    ).resized(tags.width, tags.height)
    return CameraGuess(camera, _FACTORY, "XMP DewarpData: the maker's calibration of this camera")


def _calibrated(tags: PhotoTags) -> CameraGuess | None:
    focal = tags.number("CalibratedFocalLength")
    if focal is None or focal <= 0.0:
        return None
    width, height = _taken_size(tags)
    x, y = tags.number("CalibratedOpticalCenterX"), tags.number("CalibratedOpticalCenterY")
    camera = Camera(
        width, height, focal, focal, width / 2 if x is None else x, height / 2 if y is None else y
    ).resized(tags.width, tags.height)
    return CameraGuess(camera, _NOMINAL, "XMP CalibratedFocalLength")


def _perspective(tags: PhotoTags) -> CameraGuess | None:
    """Camera of Pix4D's ``Camera:`` tags (Parrot, Autel, senseFly), millimetres on the sensor."""
    focal_mm = tags.number("PerspectiveFocalLength")
    resolution = tags.exif_number("FocalPlaneXResolution")
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0}.get(int(tags.exif_number("FocalPlaneResolutionUnit") or 0))
    if focal_mm is None or focal_mm <= 0.0:
        return None
    if resolution and unit_mm:
        focal_px = focal_mm * resolution / unit_mm * tags.width / _taken_size(tags)[0]
    else:
        middle_mm = tags.xmp.get("PrincipalPoint", "").split(",")[0]
        try:
            focal_px = focal_mm / (2.0 * float(middle_mm)) * tags.width
        except (ValueError, ZeroDivisionError):
            return None
    return CameraGuess(
        _pinhole(tags.width, tags.height, focal_px), _NOMINAL, "XMP PerspectiveFocalLength"
    )


def _by_sensor(tags: PhotoTags) -> CameraGuess | None:
    sensor_mm = _SENSOR_WIDTH_MM.get(tags.model.upper().replace(" ", ""))
    focal_mm = tags.exif_number("FocalLength")
    if sensor_mm is None or focal_mm is None:
        return None
    camera = _pinhole(tags.width, tags.height, focal_mm / sensor_mm * tags.width)
    return CameraGuess(
        camera, _ROUNDED, f"EXIF focal length and the sensor's width of {tags.model}"
    )


def _equivalent(tags: PhotoTags) -> CameraGuess | None:
    focal = tags.exif_number("FocalLengthIn35mmFilm")
    if focal is None:
        return None
    own_mm = tags.exif_number("FocalLength")
    small = own_mm is not None and own_mm < _SMALL_SENSOR_MM
    zoom = tags.exif_number("DigitalZoomRatio") or 1.0
    camera = equivalent_camera(tags.width, tags.height, focal, small=small)
    if zoom > 1.0:
        camera = _pinhole(tags.width, tags.height, camera.fx * zoom)
    return CameraGuess(camera, _ROUNDED, f"EXIF 35 mm equivalent focal length, {focal:g} mm")


def _taken_size(tags: PhotoTags) -> tuple[int, int]:
    """Size at which the photo was taken, before it was shrunk: tags in pixels refer to it."""
    width = tags.exif_number("ExifImageWidth")
    height = tags.exif_number("ExifImageHeight")
    if width is None or height is None:
        return tags.width, tags.height
    if abs(width / height / (tags.width / tags.height) - 1.0) > 0.01:
        return tags.width, tags.height
    return int(width), int(height)
