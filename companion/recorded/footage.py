"""Reads any footage as a `RecordedFlight`: photos or a video, with telemetry beside them."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from companion.errors import FootageError
from companion.recorded.autopilot_log import LOG_SUFFIXES, LogTrack, read_autopilot_log
from companion.recorded.cameras import camera_of_file, camera_of_tags, equivalent_camera
from companion.recorded.clock import ClockOffset, exposures_of, find_offset
from companion.recorded.flight import (
    CameraGuess,
    Kind,
    LogBeside,
    RecordedFlight,
    RecordedFrame,
    RecordedPosition,
    Telemetry,
    Track,
)
from companion.recorded.klv_video import read_klv
from companion.recorded.photo_tags import (
    PHOTO_SUFFIXES,
    PLACES_SUFFIXES,
    RAW_SUFFIXES,
    PhotoTags,
    read_photo_tags,
    read_places,
)
from companion.recorded.sequence import is_sequence, read_sequence
from companion.recorded.video import (
    VIDEO_SUFFIXES,
    Subtitles,
    VideoFacts,
    extract_frames,
    read_subtitles,
    video_facts,
)
from companion.sources.base import fitted_camera
from companion.sources.folder_source import list_images
from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import ecef_from_geodetic
from localizer.plain_files import files_of

_T = TypeVar("_T")
Progress = Callable[[int, int], None]
_VIDEO_FOCAL_PERCENT = 5.0  # a video's crop of the sensor is not told
_KLV_FOCAL_PERCENT = 3.0
_FOV_FOCAL_PERCENT = 5.0
_UTC_REACH_S = 3.0  # of clocks that both claim to be UTC
_CUT_S = 5.0  # between the ends of a video and of its subtitles, which come with every frame
_ELSEWHERE_M = 1000.0  # between two records of one flight
_DAY_NS = 86_400 * 10**9
_LEAST_STEP_NS, _PAIR_NS = 500_000_000, 1_000_000_000  # between frames of a video


@dataclass(frozen=True)
class FootageOptions:
    """The user's options. frames: largest number; places, log: files of telemetry; fov_deg:
    horizontal; fixed_pitch_deg: of a camera on the airframe, for a log without a gimbal; work:
    folder for a video's frames; name: of a sequence in PiLoT's data set.
    """

    work: Path
    frames: int = 100
    places: Path | None = None
    log: Path | None = None
    camera: Path | None = None
    fov_deg: float | None = None
    fixed_pitch_deg: float = -90.0
    name: str | None = None


def read_footage(
    path: Path, options: FootageOptions, progress: Progress = lambda _done, _total: None
) -> RecordedFlight:
    """Read photos or a video with all telemetry in them or beside them. A video's frames are
    written to ``options.work/frames``. progress: called with (done, all) images.
    `FootageError` says what is missing and which option gives it.
    """
    if not path.exists():
        raise FootageError(f"{path}: no such file or folder")
    _check_files(options)
    if path.suffix.lower() in RAW_SUFFIXES:
        raise FootageError(f"{path}: raw photos are not read; give the JPEG of the same shot")
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        return _read_video(path, options, progress)
    if path.is_file() and path.suffix.lower() in PHOTO_SUFFIXES:
        return _read_photos(path.parent, [path], options, progress)
    if not path.is_dir():
        raise FootageError(f"{path}: neither a photo ({_list(PHOTO_SUFFIXES)}) nor a video "
                           f"({_list(VIDEO_SUFFIXES)})")  # fmt: skip
    if options.places is None and options.log is None and is_sequence(path):
        return _read_sequence(path, options)
    return _read_folder(path, options, progress)


def _check_files(options: FootageOptions) -> None:
    """`FootageError` if a file that is given is none, or not of its kind."""
    given = {"--places": options.places, "--log": options.log, "--camera": options.camera}
    for option, file in given.items():
        if file is not None and not file.is_file():
            fault = "is a folder; give the file" if file.is_dir() else "no such file"
            raise FootageError(f"{option} {file}: {fault}")
    if options.places is not None and options.places.suffix.lower() in LOG_SUFFIXES:
        raise FootageError(f"--places {options.places}: is an autopilot's log; give it as --log")
    if options.log is not None and options.log.suffix.lower() not in LOG_SUFFIXES:
        raise FootageError(
            f"--log {options.log}: no autopilot's log ({_list(LOG_SUFFIXES)}); a file with places "
            "of photos is given as --places"
        )


def _list(suffixes: frozenset[str]) -> str:
    return ", ".join(sorted(suffixes))


def _read_sequence(path: Path, options: FootageOptions) -> RecordedFlight:
    flight = read_sequence(path, options.name)
    camera, told = flight.camera, flight.camera.camera
    if options.camera is not None or options.fov_deg is not None:
        camera = _given_camera(path, told.width, told.height, options) or camera
    return replace(flight, camera=camera, frames=tuple(_spread(flight.frames, options.frames)))


def _read_folder(path: Path, options: FootageOptions, progress: Progress) -> RecordedFlight:
    inner = path / "images"
    for folder in (path, inner):
        if not folder.is_dir():
            continue
        photos, videos = files_of(folder, PHOTO_SUFFIXES), files_of(folder, VIDEO_SUFFIXES)
        if photos and videos:
            raise FootageError(
                f"{folder}: holds {len(photos)} photos and {len(videos)} videos; give one of the "
                "videos, or a folder of photos alone"
            )
        if len(videos) > 1:
            raise FootageError(f"{folder}: holds {len(videos)} videos; give one of them")
        if videos:
            return _read_video(videos[0], options, progress)
        if photos:
            ordered = [f for f in list_images(folder) if f in photos]
            return _read_photos(path, ordered, options, progress)
    if files_of(path, RAW_SUFFIXES):
        raise FootageError(f"{path}: holds raw photos only, which are not read; give JPEGs")
    full = [f.name for f in sorted(path.iterdir()) if f.is_dir() and files_of(f, PHOTO_SUFFIXES)]
    advice = f"; give one of its folders: {', '.join(full)}" if full else ""
    raise FootageError(f"{path}: holds no photo and no video{advice}")


def _read_photos(
    folder: Path, photos: Sequence[Path], options: FootageOptions, progress: Progress
) -> RecordedFlight:
    notes: list[str] = []
    photos = _without_duplicates(photos, notes)
    chosen = _spread(photos, options.frames)
    if len(chosen) < len(photos):
        notes.append(f"{len(chosen)} of {len(photos)} photos are used (--frames)")
    tags, damaged = [], []
    for number, photo in enumerate(chosen, 1):
        try:
            tags.append(read_photo_tags(photo))
        except FootageError as error:
            damaged.append(error)
        progress(number, len(chosen))
    if not tags:
        raise damaged[0]
    if damaged:
        notes.append(f"{len(damaged)} photos are left out, the first: {damaged[0]}")
    tags = _photos_of_main_camera(tags, notes)
    if tags[0].was_turned:
        raise FootageError(
            f"{tags[0].path}: another program turned its pixels, and its angles are of the image "
            "before that; give the camera's own files"
        )
    camera = _photo_camera(folder, tags, options)
    frames = [RecordedFrame(t.path.name, t.path, t.time_ns, t.telemetry()) for t in tags]
    zero = sum(t.has_zero_view for t in tags)
    if zero:
        notes.append(
            f"{zero} of {len(tags)} photos have gimbal angles that are exactly zero: these are "
            "taken as not measured"
        )
    wrong = [f"{t.path.name}: {t.wrong_place}" for t in tags if t.wrong_place is not None]
    if wrong:
        notes.append(f"{len(wrong)} photos lose their position, the first: {wrong[0]}")
    turned = sum((t.exif_number("Orientation") or 1) != 1 for t in tags)
    if turned:
        notes.append(f"{turned} photos are marked as rotated; they are used as the sensor saw them")
    frames = _with_places(frames, _places_file(folder, tags, options, notes), notes)
    frames.sort(key=lambda f: f.time_ns if f.time_ns is not None else 0)
    log = _log_file(folder, options)
    beside = None
    if log is not None:
        frames, beside = _with_log(frames, camera.camera, log, options, notes, utc=True)
    return _flight(folder, "photos", frames, camera, notes, beside)


def _without_duplicates(photos: Sequence[Path], notes: list[str]) -> list[Path]:
    """Each photograph once: the same file again is no further evidence. Adds a note."""
    sizes = Counter(photo.stat().st_size for photo in photos)
    first: dict[object, Path] = {}
    for photo in photos:
        key: object = photo
        if sizes[photo.stat().st_size] > 1:
            key = hashlib.sha256(photo.read_bytes()).digest()
        first.setdefault(key, photo)
    if len(first) < len(photos):
        notes.append(f"{len(photos) - len(first)} photos repeat others byte by byte: left out")
    return list(first.values())


def _flight(
    path: Path, kind: Kind, frames: Sequence[RecordedFrame], camera: CameraGuess,
    notes: list[str], log: LogBeside | None,
) -> RecordedFlight:  # fmt: skip
    missing = sum(f.telemetry.position is None for f in frames)
    if missing:
        notes.append(f"{missing} of {len(frames)} frames have no position")
    return RecordedFlight(path.name, kind, tuple(frames), camera, tuple(notes), log)


def _spread(items: Sequence[_T], most: int) -> list[_T]:
    picked = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))
    return [items[int(k)] for k in picked]


def _photos_of_main_camera(tags: Sequence[PhotoTags], notes: list[str]) -> list[PhotoTags]:
    """Photos of the camera that took most; lenses of one drone differ. Adds a note."""
    sizes = Counter((t.model, t.width, t.height) for t in tags)
    (model, width, height), count = sizes.most_common(1)[0]
    if count < len(tags):
        notes.append(
            f"{len(tags) - count} photos of another camera or size are left out; those of "
            f"{model or 'one camera'} at {width}x{height} are used"
        )
    return [t for t in tags if (t.model, t.width, t.height) == (model, width, height)]


def _photo_camera(folder: Path, tags: Sequence[PhotoTags], options: FootageOptions) -> CameraGuess:
    width, height = tags[0].width, tags[0].height
    given = _given_camera(folder, width, height, options)
    if given is not None:
        return given
    try:
        return camera_of_tags(tags[0])
    except FootageError:
        beside = [
            file
            for place in (folder, folder.parent)
            for file in files_of(place, {".json", ".yaml", ".yml"})
            if file.stem.lower().startswith("cam")
        ]
        if len(beside) != 1:
            raise
        return _camera_file(beside[0], width, height)


def _given_camera(
    folder: Path, width: int, height: int, options: FootageOptions
) -> CameraGuess | None:
    """Camera by --camera, --fov or a camera.json beside the footage; None without."""
    if options.fov_deg is not None:
        camera = Camera.from_fov(width, height, options.fov_deg)
        return CameraGuess(camera, _FOV_FOCAL_PERCENT, "--fov")
    file = options.camera or folder / "camera.json"
    if options.camera is None and not file.is_file():
        return None
    return _camera_file(file, width, height)


def _camera_file(file: Path, width: int, height: int) -> CameraGuess:
    try:
        guess = camera_of_file(file)
        return replace(guess, camera=fitted_camera(width, height, guess.camera, str(file)))
    except CameraError as error:
        raise FootageError(f"{error}; or give the field of view alone, as --fov DEGREES") from error


def _places_file(
    folder: Path, tags: Sequence[PhotoTags], options: FootageOptions, notes: list[str]
) -> Path | None:
    if options.places is not None:
        return options.places
    names = {t.path.name for t in tags} | {t.path.stem for t in tags}
    candidates = []
    for file in files_of(folder, PLACES_SUFFIXES):
        try:
            if names & read_places(file).keys():
                candidates.append(file)
            else:
                notes.append(f"not used: {file.name} names none of the photos")
        except FootageError as error:
            if file.suffix.lower() == ".csv":
                notes.append(f"not used: {error}")
    if len(candidates) > 1:
        told = ", ".join(f.name for f in candidates)
        raise FootageError(f"{folder}: several files hold places of the photos: {told}; choose one "
                           "by --places")  # fmt: skip
    return candidates[0] if candidates else None


def _with_places(
    frames: Sequence[RecordedFrame], file: Path | None, notes: list[str]
) -> list[RecordedFrame]:
    """Frames with the positions of the file, which take precedence over the tags."""
    if file is None:
        return list(frames)
    places = read_places(file)
    found = 0
    told = []
    for frame in frames:
        said = places.get(frame.name) or places.get(Path(frame.name).stem)
        if said is None:
            told.append(frame)
            continue
        found += 1
        own = frame.telemetry
        merged = replace(
            own, position=said.position, view=said.view or own.view,
            course_deg=said.course_deg if said.course_deg is not None else own.course_deg,
        )  # fmt: skip
        time_ns = said.time_ns if said.time_ns is not None else frame.time_ns
        told.append(replace(frame, telemetry=merged, time_ns=time_ns))
    if not found:
        raise FootageError(f"{file}: names none of the photos; first photo: {frames[0].name}")
    notes.append(f"places of {found} of {len(frames)} photos are read from {file.name}")
    return told


def _log_file(folder: Path, options: FootageOptions) -> Path | None:
    if options.log is not None:
        return options.log
    logs = files_of(folder, LOG_SUFFIXES)
    if len(logs) > 1:
        raise FootageError(f"{folder}: holds {len(logs)} logs; choose one by --log")
    return logs[0] if logs else None


def _with_log(
    frames: Sequence[RecordedFrame], camera: Camera, file: Path, options: FootageOptions,
    notes: list[str], *, utc: bool,
) -> tuple[list[RecordedFrame], LogBeside]:  # fmt: skip
    """Frames with telemetry of the log, by the clocks' offset. utc: the images' clock is UTC."""
    log = read_autopilot_log(file, options.fixed_pitch_deg)
    notes.extend(log.notes)
    is_dated = all(f.time_ns is not None for f in frames)
    reach = _reach_s(frames, log, file, utc=utc) if is_dated else None
    exposed = exposures_of([f.time_ns for f in frames], log.exposures) if utc else None
    told: Sequence[Telemetry | None]
    if exposed is not None:
        told = exposed
        stamps = [(e.time_ns or 0) - (f.time_ns or 0) for f, e in zip(frames, exposed, strict=True)]
        ahead_ns = round(float(np.median(stamps))) if is_dated else 0
        by = f"times, {1e-9 * ahead_ns:+.2f} s apart" if is_dated else "order: they have no times"
        notes.append(f"each image is one of {file.name}'s exposures (CAM, TRIG), by their {by}")
    elif reach is None:
        raise FootageError(
            f"{file}: the images have no times, so the log cannot be laid beside them; use "
            "photos whose tags say when they were taken, or a video"
        )
    else:
        if utc and log.exposures:
            notes.append(
                f"the {len(log.exposures)} exposures in {file.name} (CAM, TRIG) cannot be told "
                "apart by the images' times: not used"
            )
        found = find_offset(frames, camera, log.track, reach)
        ahead_ns = round(1e9 * _offset(found, file, notes, utc=utc))
        told = [log.track.at((frame.time_ns or 0) + ahead_ns) for frame in frames]
    covered = sum(said is not None for said in told)
    if not covered:
        raise FootageError(
            f"{file}: says nothing of the time of the images: is it this flight's, and complete?"
        )
    apart_m = [
        _apart_m(frame.telemetry.position, said.position)
        for frame, said in zip(frames, told, strict=True)
        if said is not None and frame.telemetry.position and said.position
    ]
    if apart_m and float(np.median(apart_m)) > _ELSEWHERE_M:
        raise FootageError(
            f"{file}: places the images {np.median(apart_m) * 1e-3:.0f} km from where their own "
            "telemetry has them: is it this flight's?"
        )
    if covered < len(frames):
        notes.append(f"{file.name} covers {covered} of {len(frames)} images: is it complete?")
    moved = [
        frame if said is None else frame.with_telemetry(said)
        for frame, said in zip(frames, told, strict=True)
    ]
    fixed_pitch_deg = None if log.has_gimbal else options.fixed_pitch_deg
    return moved, LogBeside(file, ahead_ns, fixed_pitch_deg)


def _apart_m(a: RecordedPosition, b: RecordedPosition) -> float:
    """Horizontal distance of two positions, m."""
    ecef = [ecef_from_geodetic(p.latitude_deg, p.longitude_deg, 0.0) for p in (a, b)]
    return float(np.linalg.norm(ecef[0] - ecef[1]))


def _reach_s(
    frames: Sequence[RecordedFrame], log: LogTrack, file: Path, *, utc: bool
) -> tuple[float, float]:
    """Clock offsets to search (least, greatest), s. `FootageError` for a log of another time."""
    times = [f.time_ns for f in frames if f.time_ns is not None]
    begin, end = int(log.track.times_ns[0]), int(log.track.times_ns[-1])
    if utc and times[0] <= end and times[-1] >= begin:
        return -_UTC_REACH_S, _UTC_REACH_S
    if utc:
        # A camera's clock is of its own time zone: whole quarters of an hour are looked at.
        apart_s = (0.5 * (begin + end) - 0.5 * (times[0] + times[-1])) / 1e9
        hours = round(apart_s / 900.0) * 900.0
        if abs(apart_s) > _DAY_NS / 1e9:
            raise FootageError(
                f"{file}: is of another day than the images, {apart_s / 86400.0:+.1f} days away"
            )
        half_s = 0.5 * (end - begin) / 1e9
        return hours - half_s - 60.0, hours + half_s + 60.0
    return (begin - times[0]) / 1e9, (end - times[-1]) / 1e9


def _offset(found: ClockOffset | None, file: Path, notes: list[str], *, utc: bool) -> float:
    if found is not None and found.is_decisive:
        notes.append(f"clock of the images against {file.name}: {found.text}")
        return found.offset_s
    best = "" if found is None else f"; not decisive: {found.text}"
    if not utc:
        raise FootageError(
            f"{file}: where the video lies in it cannot be found by motion: is it this flight's, "
            f"and does it show turns?{best}"
        )
    notes.append(
        f"the clock's offset against {file.name} cannot be found by motion: taken as zero, as "
        f"both are UTC{best}"
    )
    return 0.0


def _read_video(path: Path, options: FootageOptions, progress: Progress) -> RecordedFlight:
    notes: list[str] = []
    facts = video_facts(path)
    duration_ns = round(1e9 * max(facts.duration_s, 1e-3))
    log = options.log or _file_beside(path, LOG_SUFFIXES)
    times = _times(duration_ns, options.frames, in_pairs=log is not None)
    extracted = extract_frames(path, options.work / "frames", times, progress)
    if facts.assumed:
        notes.append(facts.assumed)
    if facts.rotation_deg % 360:
        notes.append(
            f"the video is marked as rotated by {facts.rotation_deg} degrees; its frames are used "
            "as they are stored"
        )
    subtitles = _subtitles(path)
    if subtitles is not None:
        notes += _mismatches(subtitles, facts)
    track, focal_35mm, klv_fov = _video_track(path, subtitles, notes)
    width, height = extracted[0].width, extracted[0].height
    camera = _video_camera(path, width, height, options, focal_35mm, klv_fov)
    frames = []
    for image in extracted:
        said = track.at(image.time_ns) if track is not None else None
        frames.append(
            RecordedFrame(image.path.name, image.path, image.time_ns, said or Telemetry())
        )
    beside = None
    if log is not None:
        frames, beside = _with_log(frames, camera.camera, log, options, notes, utc=False)
    elif track is None and facts.has_dji_track:
        notes.append(
            "the telemetry inside DJI's video is not read: give its .SRT (the camera's setting "
            "'video subtitles' writes it), or the aircraft's log (--log); every frame is searched "
            "on the whole map"
        )
    elif track is None:
        notes.append(
            "the video has no telemetry: no .SRT beside it, no KLV in it, no log; every frame is "
            "searched on the whole map"
        )
    return _flight(path, "video", frames, camera, notes, beside)


def _times(duration_ns: int, frames: int, *, in_pairs: bool) -> list[int]:
    """Times (ns) at which frames are taken. in_pairs: every second frame follows the one before
    closely, so that the motion between them can be seen in a long video.
    """
    step_ns = max(duration_ns // frames, _LEAST_STEP_NS)
    times = list(range(0, duration_ns, step_ns))
    if not in_pairs or step_ns <= _PAIR_NS:
        return times
    return [t + late for t in times[::2] for late in (0, _PAIR_NS) if t + late < duration_ns]


def _file_beside(path: Path, suffixes: frozenset[str]) -> Path | None:
    """File of the same name with another ending, in any letter case; None without."""
    return next((f for f in files_of(path.parent, suffixes) if f.stem == path.stem), None)


def _subtitles(path: Path) -> Subtitles | None:
    file = _file_beside(path, frozenset({".srt"}))
    return read_subtitles(file) if file is not None else None


def _mismatches(subtitles: Subtitles, facts: VideoFacts) -> list[str]:
    """Notes if the subtitles seem to be of another video, or of a part of it."""
    doubts = []
    if subtitles.day and facts.day and abs((subtitles.day - facts.day).days) > 1:
        doubts.append(
            f"the subtitles are of {subtitles.day}, the video says {facts.day}: are they of "
            "another flight? Their positions are used"
        )
    if abs(subtitles.last_s - facts.duration_s) > _CUT_S:
        doubts.append(
            f"the subtitles end at {subtitles.last_s:.0f} s, the video at {facts.duration_s:.0f} "
            "s: is one of them cut? If the begin is missing, all positions are of another time"
        )
    return doubts


def _video_track(
    path: Path, subtitles: Subtitles | None, notes: list[str]
) -> tuple[Track | None, float | None, float | None]:
    """Telemetry on the video's time, 35 mm equivalent, field of view (degrees); None: unknown."""
    if subtitles is not None:
        notes.append(f"telemetry is read from the subtitles: {len(subtitles.samples)} samples")
        return Track(subtitles.samples, 5.0), subtitles.focal_35mm, None
    klv = read_klv(path)
    if klv.damaged:
        notes.append(f"{klv.damaged} of {klv.packets} KLV packets cannot be read")
    if not klv.samples:
        return None, None, klv.field_of_view_deg
    notes.append(f"telemetry is read from {klv.packets} KLV packets in the video")
    return Track(klv.samples), None, klv.field_of_view_deg


def _video_camera(
    path: Path, width: int, height: int, options: FootageOptions, focal_35mm: float | None,
    klv_fov: float | None,
) -> CameraGuess:  # fmt: skip
    given = _given_camera(path.parent, width, height, options)
    if given is not None:
        return given
    if klv_fov is not None and not math.isnan(klv_fov):
        camera = Camera.from_fov(width, height, klv_fov)
        return CameraGuess(camera, _KLV_FOCAL_PERCENT, "field of view in the video's KLV")
    if focal_35mm is not None:
        camera = equivalent_camera(width, height, focal_35mm, small=True)
        return CameraGuess(
            camera, _VIDEO_FOCAL_PERCENT, f"35 mm equivalent in the subtitles, {focal_35mm:g} mm"
        )
    raise FootageError(
        f"{path}: nothing says the focal length; give the camera's model (--camera FILE, or "
        "camera.json beside it) or its horizontal field of view (--fov DEGREES)"
    )
