"""Photos with tags as drones write them, made for the tests."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

DJI = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description rdf:about="DJI Meta Data"
 xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>"""


def dji(**tags: object) -> str:
    """An XMP packet with DJI's tags as attributes."""
    return DJI.format(attributes=" ".join(f'drone-dji:{k}="{v}"' for k, v in tags.items()))


def elements(body: str) -> str:
    """An XMP packet with tags as elements."""
    return f"<x:xmpmeta><rdf:RDF><rdf:Description>{body}</rdf:Description></rdf:RDF></x:xmpmeta>"


def write_photo(
    path: Path,
    xmp: str = "",
    *,
    place: tuple[float, float, float] | None = None,
    exif: dict[int, object] | None = None,
    size: tuple[int, int] = (64, 48),
    pixels: np.ndarray | None = None,
) -> Path:
    """A JPEG. place: latitude, longitude, altitude for EXIF; exif: further tags by number."""
    image = Image.fromarray(pixels) if pixels is not None else Image.new("RGB", size, (90, 120, 60))
    tags = Image.Exif()
    inner = tags.get_ifd(ExifTags.IFD.Exif)
    for number, value in (exif or {}).items():
        (inner if number > 0x8800 else tags)[number] = value
    if place is not None:
        gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
        latitude, longitude, altitude = place
        gps[ExifTags.GPS.GPSLatitudeRef] = "N" if latitude >= 0 else "S"
        gps[ExifTags.GPS.GPSLatitude] = _parts(latitude)
        gps[ExifTags.GPS.GPSLongitudeRef] = "E" if longitude >= 0 else "W"
        gps[ExifTags.GPS.GPSLongitude] = _parts(longitude)
        gps[ExifTags.GPS.GPSAltitude] = altitude
    image.save(path, quality=95, exif=tags, xmp=xmp.encode() or None)
    return path


def _parts(degrees: float) -> tuple[float, float, float]:
    whole = math.floor(abs(degrees))
    minutes = (abs(degrees) - whole) * 60
    return float(whole), float(math.floor(minutes)), (minutes - math.floor(minutes)) * 60
