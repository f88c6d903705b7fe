"""The sample of `companion try`: ``python -m benchmarks.site.footage examples/footage``.

Eight photos of a generated town with a drone's tags, and the orthophoto and height model of an
earlier visit. The tags are wrong as real ones are: GNSS lies 4 m beside the map, the gimbal looks
3 degrees further ahead than it says.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import rasterio
from PIL import ExifTags, Image
from rasterio.transform import from_bounds

from benchmarks.common.arguments import Parser
from benchmarks.common.named_errors import named_errors
from companion.convert.angles import gimbal_of_pose
from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Pose, so3_exp
from localizer.geometry.posefile import PoseRow, read_poses, world_from_camera
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view
from sitl.demo.assets import FlightAssets, prepare
from sitl.demo.kinematic import record_scenario
from sitl.demo.scenario import CameraSpec, Scenario, ScenarioLeg

_SEED, _SIZE_M = 5, 400.0
_SIDE_M, _ORTHO_M, _DSM_M = 360.0, 0.4, 1.2
_PHOTOS = 8
_GNSS_OFF_M = np.array([-2.4, 3.2, 0.0])
_GIMBAL_OFF_DEG = 3.0
_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {tags}/>
 </rdf:RDF>
</x:xmpmeta>"""


def make(out: Path) -> None:
    """Write ``ortho.tif``, ``dsm.tif`` and ``photos/``."""
    (out / "photos").mkdir(parents=True, exist_ok=True)
    assets = prepare(_SEED, size_m=_SIZE_M)
    write_map(assets, out)
    corners = ((60.0, 60.0), (60.0, -60.0), (-60.0, -60.0))
    legs = tuple(
        ScenarioLeg(east_m=east, north_m=north, height_m=75, gimbal_pitch_deg=-90)
        for east, north in corners
    )
    camera = CameraSpec(rate_hz=1, width=960, height=720, distortion=(0.0,) * 5)
    scenario = Scenario(takeoff_height_m=75, legs=legs, cars=8, people=4, camera=camera)
    with tempfile.TemporaryDirectory() as folder:
        record_scenario(assets, scenario, _SEED, Path(folder))
        write_photos(Path(folder), TileCache.open(assets.map_cache).frame, assets, out / "photos")


def write_map(assets: FlightAssets, out: Path) -> None:
    """The map's picture and heights, as GeoTIFFs in degrees."""
    cache = TileCache.open(assets.map_cache)
    streamer = TileStreamer(cache)
    try:
        renderer, base = NumbaRenderer(streamer), float(cache.index.box_min[:, 2].min())
        for name, gsd in (("ortho", _ORTHO_M), ("dsm", _DSM_M)):
            side = round(_SIDE_M / gsd)
            view = render_top_view(renderer, np.zeros(2), side, gsd, base)
            low = cache.frame.position(np.array([-_SIDE_M / 2, -_SIDE_M / 2, 0.0]))
            high = cache.frame.position(np.array([_SIDE_M / 2, _SIDE_M / 2, 0.0]))
            bounds = (low.longitude_deg, low.latitude_deg, high.longitude_deg, high.latitude_deg)
            place = {"crs": "EPSG:4326", "transform": from_bounds(*bounds, side, side)}
            if name == "ortho":
                data, how = (
                    view.rgb.transpose(2, 0, 1),
                    {"compress": "jpeg", "photometric": "ycbcr"},
                )
            else:
                heights = np.round(view.height + cache.frame.origin.height_m, 2)
                data = heights[None].astype(np.float32)
                how = {"compress": "deflate", "predictor": "3"}
            with rasterio.open(
                out / f"{name}.tif", "w", driver="GTiff", width=side, height=side, count=len(data),
                dtype=data.dtype, **place, **how,
            ) as raster:  # fmt: skip
                raster.write(data)
    finally:
        streamer.close()


def write_photos(sequence: Path, frame: LocalFrame, assets: FlightAssets, out: Path) -> None:
    """JPEGs with DJI's tags, spread over the flight."""
    rows, camera = read_poses(sequence / "poses.txt"), Camera.from_json(sequence / "camera.json")
    chosen = np.linspace(0, len(rows) - 1, _PHOTOS).round().astype(int)
    home = np.array([0.0, 0.0, float(assets.world.ground_height(0.0, 0.0))])
    takeoff_m = assets.world.frame.position(home).height_m
    for number, k in enumerate(chosen, 1):
        image = Image.open(sequence / "images" / rows[k].name)
        focal = camera.fx * np.hypot(36.0, 24.0) / np.hypot(camera.width, camera.height)
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "DJI", "generated"
        inner = exif.get_ifd(ExifTags.IFD.Exif)
        inner[ExifTags.Base.FocalLengthIn35mmFilm] = round(float(focal))
        inner[ExifTags.Base.DateTimeOriginal] = f"2026:05:01 10:{k // 60:02d}:{k % 60:02d}"
        xmp = _XMP.format(tags=_tags(rows[k], frame, takeoff_m)).encode()
        file = out / f"DJI_{number:04d}.JPG"
        image.convert("RGB").save(file, "JPEG", quality=80, exif=exif, xmp=xmp)


def _tags(row: PoseRow, frame: LocalFrame, takeoff_m: float) -> str:
    pose = world_from_camera(row, frame)
    told = frame.position(pose.translation + _GNSS_OFF_M)
    back = so3_exp([-np.radians(_GIMBAL_OFF_DEG), 0.0, 0.0])
    gimbal = gimbal_of_pose(Pose(pose.rotation @ back, pose.translation), frame)
    tags = {
        "GpsLatitude": f"{told.latitude_deg:.8f}", "GpsLongitude": f"{told.longitude_deg:.8f}",
        "RelativeAltitude": f"{told.height_m - takeoff_m:+.2f}",
        "GimbalRollDegree": f"{gimbal.roll_deg:+.2f}",
        "GimbalPitchDegree": f"{gimbal.pitch_deg:+.2f}",
        "GimbalYawDegree": f"{gimbal.yaw_deg:+.2f}",
    }  # fmt: skip
    return " ".join(f'drone-dji:{name}="{value}"' for name, value in tags.items())


def main() -> None:
    """Make it."""
    parser = Parser(__doc__)
    parser.add_argument("folder", type=Path, help="where the sample goes")
    make(parser.parse_args().folder)


if __name__ == "__main__":
    with named_errors():
        main()
