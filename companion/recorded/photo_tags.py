"""Reads photo tags: EXIF and XMP of DJI, Autel, Parrot, Skydio and senseFly.

XMP is in the JPEG (an APP1 segment) or beside it as NAME.xmp, which takes precedence. Angles are
converted to those of `companion.recorded.flight`; `_VIEWS` has each maker's convention.

Positions of photos in a file beside them, CSV or text: with a header, columns are found by name.
Without one, lines are ``name longitude latitude [altitude]``, as in OpenDroneMap's geo.txt and this
project's pose files.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from companion.errors import FootageError
from companion.recorded.flight import (
    ABSOLUTE_M,
    HEADING_DEG,
    Datum,
    Height,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from localizer.plain_files import plain_text

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".tif", ".tiff", ".png"})
RAW_SUFFIXES = frozenset({".dng", ".arw", ".cr2", ".cr3", ".nef", ".raf"})
_XMP_BEGIN, _XMP_END = b"<x:xmpmeta", b"</x:xmpmeta>"
_LARGEST_BYTES = 1 << 20  # of a photo's head, in which its tags stand
_TAG = r"(?:[\w-]+):(\w+)"

# Standard deviations of what the tags say. DJI states 0.5 to 1.5 m for hovering with GNSS; photos
# are tagged in motion (5 to 15 m/s, up to 0.2 s late).
_GNSS_M, _RTK_M = 3.0, 0.1
_GNSS_HEIGHT_M = 8.0
_LARGEST_SIGMA_M = 1e5  # as in a file of places
_DOWN_DEG = 10.0  # of a camera of which nothing is said: survey photos look down


@dataclass(frozen=True)
class PhotoTags:
    """The tags of one photo. exif: by EXIF name; xmp: by name without its namespace."""

    path: Path
    width: int
    height: int
    exif: Mapping[str, Any] = field(default_factory=dict)
    gps: Mapping[int, Any] = field(default_factory=dict)
    xmp: Mapping[str, str] = field(default_factory=dict)

    @property
    def maker(self) -> str:
        """Camera maker in lower case; "" if unknown."""
        return str(self.exif.get("Make") or self.xmp.get("Make") or "").strip("\x00 ").lower()

    @property
    def model(self) -> str:
        """Camera model; "" if unknown."""
        return str(self.exif.get("Model") or self.xmp.get("Model") or "").strip("\x00 ")

    def number(self, *names: str) -> float | None:
        """First of these XMP tags that is a finite number or a fraction such as 35/10; or None."""
        for name in names:
            value = _number(self.xmp.get(name))
            if value is not None:
                return value
        return None

    def exif_number(self, name: str) -> float | None:
        """An EXIF number; None if it is missing, not finite or 0 (unknown)."""
        value = _number(self.exif.get(name))
        return value if value else None

    @property
    def time_ns(self) -> int | None:
        """Nanoseconds since 1970 on the photo's clock, of unknown time zone."""
        text = str(self.exif.get("DateTimeOriginal") or self.exif.get("DateTime") or "")
        try:
            day = datetime.strptime(text.strip("\x00 "), "%Y:%m:%d %H:%M:%S")
        except ValueError:
            return None
        seconds = day.replace(tzinfo=timezone.utc).timestamp()
        part = str(self.exif.get("SubsecTimeOriginal") or "").strip("\x00 ")
        fraction = float(f"0.{part}") if part.isdecimal() else 0.0
        return round((seconds + fraction) * 1e9)

    @property
    def was_turned(self) -> bool:
        """Whether another program rotated the image, so that its tags do not fit."""
        width, height = self.exif_number("ExifImageWidth"), self.exif_number("ExifImageHeight")
        if width is None or height is None or width == height or self.width == self.height:
            return False
        return (width > height) != (self.width > self.height)

    def telemetry(self) -> Telemetry:
        """Position and direction, as far as known; no position if it is off the Earth
        (`wrong_place`).
        """
        return Telemetry(self.time_ns, self._position(), self.view(), self._course())

    def view(self) -> RecordedView | None:
        """The measured camera direction, by the first maker's convention that fits; None if no tag
        has it, or all angles are exactly zero (`has_zero_view`).
        """
        for names, convert in _VIEWS:
            angles = [self.number(name) for name in names]
            values = [a for a in angles if a is not None]
            # All three exactly zero: the firmware has no measurement (DJI Mini 2, P1).
            if len(values) == 3 and any(values):
                roll, pitch, yaw = convert(values[0], values[1], values[2])
                roll = -roll if self.maker == "sensefly" else roll  # positive to the left there
                return RecordedView.of_angles(roll, pitch, yaw)
        return None

    @property
    def has_zero_view(self) -> bool:
        """Whether all angles are exactly zero, so that they were not measured."""
        return self.view() is None and any(
            all(self.number(name) == 0.0 for name in names) for names, _ in _VIEWS
        )

    def _course(self) -> float | None:
        course = self.number("FlightYawDegree", "DroneYaw", "DroneOrientationNEDYaw")
        if course is not None:
            return course
        return _number(self.gps.get(ExifTags.GPS.GPSImgDirection))

    @property
    def _place(self) -> tuple[float, float] | None:
        """Latitude and longitude as the tags state them; None if they are missing or both 0."""
        # "GpsLongtitude" is how some of DJI's firmwares spell it.
        latitude = self.number("GpsLatitude", "Latitude")
        longitude = self.number("GpsLongitude", "GpsLongtitude", "Longitude")
        if latitude is None or longitude is None:
            latitude, longitude = self._exif_place
        if latitude is None or longitude is None or (latitude == 0.0 and longitude == 0.0):
            return None
        return latitude, longitude

    @property
    def wrong_place(self) -> str | None:
        """The fault of tags whose position is off the Earth; else None."""
        if self._place is None or (abs(self._place[0]) <= 90.0 and abs(self._place[1]) <= 360.0):
            return None
        latitude, longitude = self._place
        return f"tags say latitude {latitude:g}, longitude {longitude:g}: no place on Earth"

    def _position(self) -> RecordedPosition | None:
        if self._place is None or self.wrong_place is not None:
            return None
        told = [s for name in ("RtkStdLat", "RtkStdLon") if (s := self._sigma(name)) is not None]
        sigma = max(_RTK_M, *told) if told else self._sigma("GPSXYAccuracy") or _GNSS_M
        return RecordedPosition(*self._place, sigma, tuple(self._heights()))

    def _sigma(self, name: str) -> float | None:
        """A standard deviation in metres; None if the tag is missing or its value impossible."""
        value = self.number(name)
        return value if value is not None and 0.0 < value <= _LARGEST_SIGMA_M else None

    @property
    def _exif_place(self) -> tuple[float | None, float | None]:
        gps, tag = self.gps, ExifTags.GPS
        latitude = _degrees(gps.get(tag.GPSLatitude), gps.get(tag.GPSLatitudeRef) == "S")
        longitude = _degrees(gps.get(tag.GPSLongitude), gps.get(tag.GPSLongitudeRef) == "W")
        return latitude, longitude

    def _heights(self) -> list[Height]:
        relative = self.number("RelativeAltitude", "AboveGroundAltitude")
        heights = [] if relative is None else [Height.by_barometer(relative)]
        return [*heights, self.altitude] if self.altitude is not None else heights

    @property
    def altitude(self) -> Height | None:
        """The absolute height; AltitudeType, else the RTK fix, gives its datum. Or None."""
        value = self.number("AbsoluteAltitude")
        if value is None:
            value = self._exif_altitude
            return None if value is None else Height(value, Datum.AMSL, _GNSS_HEIGHT_M)
        kind = self.xmp.get("AltitudeType", "").lower()
        fixed = self.number("RtkFlag") in (16.0, 34.0, 50.0)
        if kind == "rtkalt" or (fixed and kind != "gpsfusionalt"):
            return Height(value, Datum.ELLIPSOID, _RTK_M)
        return Height(value, Datum.AMSL, ABSOLUTE_M)

    @property
    def _exif_altitude(self) -> float | None:
        value = _number(self.gps.get(ExifTags.GPS.GPSAltitude))
        # 1 and b"\x01" both occur; Pillow gives the byte as it stands. EXIF 3 has 3 below the sea.
        below = self.gps.get(ExifTags.GPS.GPSAltitudeRef, 0) in (1, 3, b"\x01", b"\x03")
        return -value if below and value is not None else value


Convert = Callable[[float, float, float], tuple[float, float, float]]


def _same(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
    return roll, pitch, yaw


def _from_nadir(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
    """Gimbal angles of Pix4D's ``Camera:`` tags, whose pitch is 0 down, 90 ahead."""
    return roll, pitch - 90.0, yaw


# Names of roll, pitch and yaw in each maker's XMP, and how they become a gimbal's angles.
_VIEWS: tuple[tuple[tuple[str, str, str], Convert], ...] = (
    (("GimbalRollDegree", "GimbalPitchDegree", "GimbalYawDegree"), _same),  # DJI
    (("CameraOrientationNEDRoll", "CameraOrientationNEDPitch", "CameraOrientationNEDYaw"), _same),
    (("CameraRollDegree", "CameraPitchDegree", "CameraYawDegree"), _same),  # Parrot ANAFI
    (("Roll", "Pitch", "Yaw"), _from_nadir),
)


def looking_down(heading_deg: float | None) -> RecordedView:
    """The assumed direction without a measurement: straight down, top of the image ahead.

    heading_deg: of the aircraft, None if unknown.
    """
    sigma = None if heading_deg is None else 2.0 * HEADING_DEG
    return RecordedView.of_angles(0.0, -90.0, heading_deg or 0.0, _DOWN_DEG, sigma, measured=False)


def read_photo_tags(path: Path) -> PhotoTags:
    """Tags of a photo, or of a sidecar (.xmp) alone, size 0; `FootageError` if it is no image."""
    if path.suffix.lower() == ".xmp":
        return PhotoTags(path, 0, 0, xmp=_read_xmp(path))
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            base = {ExifTags.TAGS.get(k, str(k)): v for k, v in exif.items()}
            inner = exif.get_ifd(ExifTags.IFD.Exif)
            more = {ExifTags.TAGS.get(k, str(k)): v for k, v in inner.items()}
            gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
            width, height = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise FootageError(f"{path}: not an image that can be read: {error}") from error
    return PhotoTags(path, width, height, base | more, gps, _read_xmp(path))


def _read_xmp(path: Path) -> dict[str, str]:
    """XMP tags by name, attributes and elements alike; empty where there are none. `FootageError`
    if the file cannot be read.
    """
    sidecar = next((p for p in map(path.with_suffix, (".xmp", ".XMP")) if p.is_file()), None)
    try:
        if sidecar is not None:
            text = plain_text(sidecar)
        else:
            with path.open("rb") as file:
                head = file.read(_LARGEST_BYTES)
            begin = head.find(_XMP_BEGIN)
            end = head.find(_XMP_END, begin)
            text = head[begin:end].decode("utf-8", "replace") if 0 <= begin < end else ""
    except (OSError, UnicodeDecodeError) as error:
        raise FootageError(f"{path}: cannot be read: {error}") from error
    tags = dict(re.findall(rf"""\s{_TAG}\s*=\s*["']([^"']*)["']""", text))
    tags |= dict(re.findall(rf"<{_TAG}>\s*([^<]*?)\s*</", text))
    # A structure of Skydio and Parrot: <a:CameraOrientationNED><a:Pitch>..</a:Pitch>...
    for name, body in re.findall(r"<[\w-]+:(\w+NED)[^>]*>(.*?)</[\w-]+:\1>", text, re.DOTALL):
        for part, value in re.findall(rf"<{_TAG}>\s*([^<]*?)\s*</", body):
            tags[f"{name}{part}"] = value
        for part, value in re.findall(rf'\s{_TAG}\s*=\s*"([^"]*)"', body):
            tags[f"{name}{part}"] = value
    return tags


def _number(value: Any) -> float | None:
    try:
        if isinstance(value, str) and "/" in value:
            above, below = value.split("/", 1)
            number = float(above) / float(below)
        else:
            number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _degrees(parts: Sequence[Any] | None, negative: bool) -> float | None:
    try:
        degrees, minutes, seconds = (float(part) for part in parts or ())
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    value = degrees + minutes / 60.0 + seconds / 3600.0
    if not math.isfinite(value):
        return None
    return -value if negative else value


PLACES_SUFFIXES = frozenset({".csv", ".txt", ".tsv"})
_UNKNOWN_M, _HEIGHT_M = 5.0, 25.0  # of a position and a height of which no one says the source
_COLUMNS = {
    "name": ("name", "filename", "file", "image", "photo", "label", "imagename"),
    "latitude": ("lat", "latitude", "gpslatitude", "latitudedeg", "y"),
    "longitude": ("lon", "lng", "long", "longitude", "gpslongitude", "longitudedeg", "x"),
    "amsl": ("alt", "altitude", "z", "elevation", "gpsaltitude", "altamslm", "amsl", "altm"),
    "ellipsoid": ("height", "heightm", "ellipsoidalheight", "hae"),
    "takeoff": ("relalt", "relativealtm", "relativealtitude", "agl", "heightabovetakeoff"),
    "roll": ("gimbalroll", "gimbalrolldeg", "cameraroll"),
    "pitch": ("gimbalpitch", "gimbalpitchdeg", "camerapitch"),
    "yaw": ("gimbalyaw", "gimbalyawdeg", "camerayaw"),
    "course": ("heading", "course", "track", "yaw", "yawdeg"),
    "time": ("utc", "timestamp", "unixtime"),
    "accuracy": ("horizontalaccuracy", "hacc", "gpsxyaccuracy", "accuracy"),
}
_LIMITS = {  # degrees; seconds since 1970, whose nanoseconds fit 64 bits; metres
    "roll": (-180.0, 180.0), "pitch": (-180.0, 90.0), "yaw": (-360.0, 360.0),
    "course": (-360.0, 360.0), "time": (0.0, 9e9), "accuracy": (1e-3, 1e5),
}  # fmt: skip


def read_places(path: Path) -> dict[str, Telemetry]:
    """Telemetry by photo name, as the file writes it; position None for 0, 0. `FootageError` for a
    file without lines of positions, a line that is none, and a name that is repeated.
    """
    try:
        lines = plain_text(path).removeprefix("\ufeff").splitlines()
        rows = list(_rows(lines))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FootageError(f"{path}: cannot be read: {error}") from error
    columns = _columns(rows[0][1]) if rows else None
    if columns is not None:
        rows = rows[1:]
    else:
        columns = {"name": 0, "longitude": 1, "latitude": 2, "amsl": 3}
    places: dict[str, Telemetry] = {}
    for number, row in rows:
        name, said = _place(row, columns, f"{path}:{number}")
        if name in places:
            raise FootageError(f"{path}:{number}: a second line of {name}; leave the right one")
        places[name] = said
    if not places:
        raise FootageError(f"{path}: holds no place; expected lines of: name longitude latitude")
    return places


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of lines that are not empty: by comma, semicolon, tab or blanks."""
    kept = [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#") and not line.upper().startswith("EPSG:")
    ]
    sample = kept[0][1] if kept else ""
    mark = next((m for m in (",", ";", "\t") if m in sample), None)
    for number, line in kept:
        fields = next(csv.reader([line], delimiter=mark)) if mark else line.split()
        yield number, [f.strip() for f in fields]


def _columns(first: list[str]) -> dict[str, int] | None:
    """Index of each known column, if the first row is a header; otherwise None."""
    if len(first) > 1 and _number_of(first[1]) is not None:
        return None
    plain = [re.sub(r"[^a-z]", "", name.lower()) for name in first]
    found = {}
    for key, names in _COLUMNS.items():
        index = next((plain.index(name) for name in names if name in plain), None)
        if index is not None:
            found[key] = index
    if not {"name", "latitude", "longitude"} <= found.keys():
        return None
    return found


def _place(row: list[str], columns: dict[str, int], where: str) -> tuple[str, Telemetry]:
    def number(key: str) -> float | None:
        index = columns.get(key)
        value = _number_of(row[index]) if index is not None and index < len(row) else None
        low, high = _LIMITS.get(key, (-math.inf, math.inf))
        if value is not None and not low <= value <= high:
            raise FootageError(f"{where}: {key} {value:g} is not from {low:g} to {high:g}")
        return value

    latitude, longitude = number("latitude"), number("longitude")
    if latitude is None or longitude is None or len(row) <= columns["name"]:
        raise FootageError(f"{where}: expected a name, longitude and latitude, got {row[:4]}")
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise FootageError(
            f"{where}: latitude {latitude:g}, longitude {longitude:g} is no place on Earth: are "
            "they swapped? Without a header, longitude comes before latitude"
        )
    heights = [
        Height(value, datum, _HEIGHT_M)
        for key, datum in (
            ("ellipsoid", Datum.ELLIPSOID), ("amsl", Datum.AMSL), ("takeoff", Datum.TAKEOFF)
        )
        if (value := number(key)) is not None
    ]  # fmt: skip
    position = None
    if latitude or longitude:  # 0, 0 is what is written without a fix
        sigma_m = number("accuracy") or _UNKNOWN_M
        position = RecordedPosition(latitude, longitude, sigma_m, tuple(heights))
    roll, pitch, yaw = number("roll"), number("pitch"), number("yaw")
    view = None
    if pitch is not None and yaw is not None:
        view = RecordedView.of_angles(roll or 0.0, pitch, yaw)
    seconds = number("time")
    time_ns = None if seconds is None else round(seconds * 1e9)
    return row[columns["name"]], Telemetry(time_ns, position, view, number("course"))


def _number_of(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
