"""The flight's record: estimates, targets and events as CSV, written on its own thread."""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np

from companion.config import CompanionConfig, RecordConfig
from companion.errors import DiskFaultError, ReportError, redacted
from companion.ground.target_files import write_target_files
from companion.preflight.map_pin import readable_map_hash
from companion.trajectory import TrajectoryFiles, snapshot_name, to_stamped_pose
from companion.versions import versions
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import quaternion_from_matrix
from localizer.types import Frame, PoseEstimate, TargetFix
from mavlink_bridge.link.clock import process_utc
from mavlink_bridge.link.tlog import is_disk_fault

_log = logging.getLogger(__name__)
_QUEUE_SIZE = 4096
_PICTURES_BYTES = 96 << 20  # of pictures that wait for a disk; one may always
_FLUSH_S = 1.0
_CLOSE_S = 5.0
MANIFEST_NAME = "record.json"
LATEST_NAME = "latest"

ESTIMATE_COLUMNS = (
    "exposure_time_ns", "sequence", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz",
    "latitude_deg", "longitude_deg", "height_m", "sigma_east_m", "sigma_north_m", "sigma_up_m",
    "sigma_rotation_rad", "quality", "state", "status", "accepted",
    "reference_ms", "extract_ms", "register_ms", "latency_ms", "hpl_m", "vpl_m",
    "focal_px",
)  # fmt: skip
TARGET_COLUMNS = (
    "exposure_time_ns", "target_id", "east_m", "north_m", "up_m",
    "latitude_deg", "longitude_deg", "height_m", "sigma_horizontal_m", "sigma_up_m",
    "velocity_east", "velocity_north", "velocity_up", "u", "v",
    "cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu", "elsewhere", "visibility",
)  # fmt: skip
EVENT_COLUMNS = ("time_ns", "level", "text", "alert")


def fresh_folder(folder: Path) -> Path:
    """`folder`, or a numbered one beside it if it already holds a record, so that a restart in
    flight does not overwrite the record. Creates nothing.
    """
    candidate, number = folder, 2
    while (candidate / "estimates.csv").exists():
        candidate = folder.with_name(f"{folder.name}-{number}")
        number += 1
    return candidate


def remove_empty(folder: Path) -> None:
    """Remove the record of a failed start, whose files hold at most column names. Any of the files
    may be missing. Does nothing if a row was written or the disk fails; keeps other files.
    """
    tables = [folder / name for name in ("estimates.csv", "targets.csv", "events.csv")]
    snapshots = folder / "snapshots"
    with contextlib.suppress(OSError):
        if any(len(t.read_text().splitlines()) > 1 for t in tables if t.exists()):
            return
        for path in (*tables, folder / MANIFEST_NAME):
            path.unlink(missing_ok=True)
        if snapshots.exists():
            snapshots.rmdir()
        folder.rmdir()  # it stays if anything else is in it


def write_manifest(folder: Path, config: CompanionConfig) -> None:
    """Write ``record.json`` into an existing folder: settings without credentials, the map's hash,
    versions, and one time on both clocks.
    The pair of clocks dates the .tlog (UTC) against everything else (CLOCK_MONOTONIC).
    `ReportError` if it cannot be written, `DiskFaultError` if the disk is the cause.
    """
    monotonic_ns = time.monotonic_ns()
    document = {
        "monotonic_ns": monotonic_ns,
        "utc_ns": process_utc().utc_ns(monotonic_ns),
        "versions": versions(),
        "map_sha256": readable_map_hash(config.map),
        "config": _without_credentials(config.model_dump(mode="json")),
    }
    try:
        (folder / MANIFEST_NAME).write_text(json.dumps(document, indent=1), encoding="utf-8")
    except OSError as error:
        raise _unwritable(folder, error) from error


def _without_credentials(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_credentials(item) for key, item in value.items()}
    return redacted(value) if isinstance(value, str) else value


def _unwritable(folder: Path, error: OSError) -> ReportError:
    kind = DiskFaultError if is_disk_fault(error) else ReportError
    return kind(f"record.folder {folder}: cannot be written: {error}")


def _estimate_row(
    estimate: PoseEstimate, levels: tuple[float, float] | None, frame: LocalFrame
) -> tuple[Any, ...]:
    """The values of `ESTIMATE_COLUMNS` for an estimate."""
    pose = estimate.world_from_camera
    position = frame.position(pose.translation)
    sigma = estimate.covariance.diagonal() ** 0.5
    stages = (estimate.stage_ms.get(k, 0.0) for k in ("reference", "extract", "register"))
    return (
        estimate.exposure_time_ns, estimate.sequence,
        *(f"{x:.4f}" for x in pose.translation),
        *(f"{x:.8f}" for x in quaternion_from_matrix(pose.rotation)),
        f"{position.latitude_deg:.9f}", f"{position.longitude_deg:.9f}",
        f"{position.height_m:.4f}",
        *(f"{x:.4f}" for x in sigma[:3]), f"{sigma[3:].max():.6f}",
        f"{estimate.quality:.4f}", estimate.state.value, estimate.status.name,
        int(estimate.accepted), *(f"{x:.2f}" for x in stages),
        f"{estimate.stage_ms.get('latency', 0.0):.2f}",
        *(("", "") if levels is None else (f"{x:.3f}" for x in levels)),
        f"{estimate.camera.fx:.3f}",
    )  # fmt: skip


def _target_row(fix: TargetFix, frame: LocalFrame) -> tuple[Any, ...]:
    """The values of `TARGET_COLUMNS` for a target's fix."""
    position = frame.position(fix.position_world)
    horizontal = (fix.covariance[0, 0] + fix.covariance[1, 1]) ** 0.5
    return (
        fix.exposure_time_ns, fix.target_id, *(f"{x:.4f}" for x in fix.position_world),
        f"{position.latitude_deg:.9f}", f"{position.longitude_deg:.9f}",
        f"{position.height_m:.4f}", f"{horizontal:.3f}", f"{fix.covariance[2, 2] ** 0.5:.3f}",
        *(("",) * 3 if fix.velocity is None else (f"{x:.3f}" for x in fix.velocity)),
        *(("",) * 2 if fix.pixel is None else (f"{x:.2f}" for x in fix.pixel)),
        *(f"{x:.5f}" for x in fix.covariance[np.triu_indices(3)]), f"{fix.elsewhere:.3f}",
        fix.visibility.value,
    )  # fmt: skip


class Recorder:
    """Writes ``estimates.csv``, ``targets.csv`` and ``events.csv`` in a folder, and the accepted
    estimates as a trajectory (`TrajectoryFiles`, created with the first of them). The constructor
    creates folder and files, replacing older ones (`ReportError`), and starts the thread.

    No method blocks its caller: rows beyond a bounded queue are dropped and counted. If the disk is
    full or gone, rows are dropped and counted too, and the flight continues without its record.
    on_failure is then called once with the reason, in the recorder's thread.
    """

    def __init__(
        self,
        config: RecordConfig,
        frame: LocalFrame,
        on_failure: Callable[[str], None] = lambda _: None,
    ) -> None:
        folder = config.folder
        self._snapshots = folder / "snapshots"
        self._interval_ns = (config.snapshot_interval_s or 0.0) * 1e9
        self._next_snapshot_ns = 0.0
        self._frame = frame
        self._rows: queue.Queue[tuple[str, Callable[[], Iterable[Any]]] | None]
        self._rows = queue.Queue(_QUEUE_SIZE)
        self._pictures_lock = threading.Lock()
        self._pictures_bytes = 0
        self.dropped = 0
        self._on_failure = on_failure
        self._failed = False
        self._folder = folder
        self._files: list[TextIO | TrajectoryFiles] = []
        self._trajectory: TrajectoryFiles | None = None
        try:
            self._snapshots.mkdir(parents=True, exist_ok=True)
            self._writers = {
                "estimates": self._open(folder / "estimates.csv", ESTIMATE_COLUMNS),
                "targets": self._open(folder / "targets.csv", TARGET_COLUMNS),
                "events": self._open(folder / "events.csv", EVENT_COLUMNS),
            }
        except OSError as error:
            raise _unwritable(folder, error) from error
        # A daemon: a disk that does not respond must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def estimate(self, estimate: PoseEstimate, levels: tuple[float, float] | None = None) -> None:
        """Record one estimate, accepted or not; the trajectory has the accepted ones. levels: its
        horizontal and vertical protection levels, m; None if none was computed.
        """
        self._put("estimates", lambda: _estimate_row(estimate, levels, self._frame))
        if estimate.accepted:
            self._put("trajectory", lambda: (estimate,))

    def target(self, fix: TargetFix) -> None:
        """Record one target fix."""
        self._put("targets", lambda: _target_row(fix, self._frame))

    def event(self, level: str, text: str, alert: str = "") -> None:
        """Record an event at the current time. level: info or warning; alert: identifier or ""."""
        row = (time.monotonic_ns(), level, text, alert)
        self._put("events", lambda: row)

    def snapshot(self, frame: Frame) -> None:
        """Store the frame's image, named by its exposure time, if the interval has passed."""
        if self._interval_ns and frame.exposure_time_ns >= self._next_snapshot_ns:
            self._next_snapshot_ns = frame.exposure_time_ns + self._interval_ns
            with self._pictures_lock:
                waiting = self._pictures_bytes
                if waiting and waiting + frame.image.nbytes > _PICTURES_BYTES:
                    self.dropped += 1
                    return
                self._pictures_bytes += frame.image.nbytes
            if not self._put("snapshot", lambda: (frame,)):
                self._written(frame)

    def close(self) -> bool:
        """Write the queue and close the files. False if the disk hangs for 10 s."""
        with contextlib.suppress(queue.Full):
            self._rows.put(None, timeout=_CLOSE_S)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.warning("the record is incomplete, its disk does not answer")
            return False
        for file in self._files:
            self._guarded(file.close)
        return True

    def _open(self, path: Path, columns: tuple[str, ...]) -> Any:
        file = path.open("w", newline="", encoding="utf-8")
        self._files.append(file)
        writer = csv.writer(file)
        writer.writerow(columns)
        return writer

    def _put(self, name: str, row: Callable[[], Iterable[Any]]) -> bool:
        """Queue a row, computed by the recorder's thread; False if the queue is full."""
        try:
            self._rows.put_nowait((name, row))
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def _written(self, frame: Frame) -> None:
        with self._pictures_lock:
            self._pictures_bytes -= frame.image.nbytes

    def _write(self, name: str, row: Callable[[], Iterable[Any]]) -> None:
        if name == "snapshot":
            (frame,) = row()
            try:
                self._write_picture(frame)
            finally:
                self._written(frame)
        elif name == "trajectory":
            (estimate,) = row()
            self._append(estimate)
        elif name:
            self._writers[name].writerow(row())

    def _write_picture(self, frame: Frame) -> None:
        # Not imwrite, which does not tell why it could not.
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        (self._snapshots / snapshot_name(frame.exposure_time_ns)).write_bytes(jpeg.tobytes())

    def _append(self, estimate: PoseEstimate) -> None:
        if self._trajectory is None:
            self._trajectory = TrajectoryFiles(self._folder, self._frame)
            self._files.append(self._trajectory)
        self._trajectory.append(to_stamped_pose(snapshot_name(estimate.exposure_time_ns), estimate))

    def _run(self) -> None:
        flushed = time.monotonic()
        while True:
            try:
                item = self._rows.get(timeout=_FLUSH_S)
            except queue.Empty:
                item = ("", tuple)
            if item is None:
                return
            self._guarded(self._write, *item)
            if time.monotonic() - flushed > _FLUSH_S:
                flushed = time.monotonic()
                for file in self._files:
                    self._guarded(file.flush)

    def _guarded(self, write: Callable[..., None], *arguments: Any) -> None:
        try:
            write(*arguments)
        except Exception as error:  # OpenCV has its own, and text that is no UTF-8 another
            self.dropped += 1
            if not self._failed:
                self._failed = True
                _log.warning("the record is incomplete: %s", error)
                self._on_failure(getattr(error, "strerror", None) or str(error))


class RecordKeeper:
    """Opens and closes the record of one process. If the disk fails, the flight continues without a
    record.

    say_incomplete: tells the operator why a part of the record is missing; called from any thread.
    """

    def __init__(self, frame: LocalFrame, say_incomplete: Callable[[str], None]) -> None:
        self._frame = frame
        self._say_incomplete = say_incomplete
        self.recorder: Recorder | None = None
        self.folder: Path | None = None
        """Where it is written; None while the disk takes none."""
        self.is_complete = True

    def open(
        self, config: CompanionConfig, record: RecordConfig, claim: Callable[[Path], None]
    ) -> None:
        """Create a record in its own folder. claim: called with the folder before it is created. If
        the disk is full or failing, the record is marked incomplete; otherwise `ReportError`.
        """
        try:
            record = record.model_copy(update={"folder": fresh_folder(record.folder)})
            claim(record.folder)
            self.recorder = Recorder(record, self._frame, self.mark_incomplete)
            self.folder = record.folder
            write_manifest(record.folder, config)
        except DiskFaultError as error:
            self.mark_incomplete(str(error.__cause__))
        except BaseException:
            self.close()
            raise

    def link(self) -> None:
        """Point the link ``latest`` beside the open record to it, unless a record has that name. A
        failure is only logged.
        """
        if self.folder is None or self.folder.name.startswith(LATEST_NAME):
            return
        link = self.folder.parent / LATEST_NAME
        if link.exists() and not link.is_symlink():
            return
        try:
            fresh = link.with_name(f".{LATEST_NAME}.new")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self.folder.name)
            fresh.replace(link)
        except OSError as error:  # a stick's file system may have no links
            _log.info("no link to the newest record: %s", error)

    def close(self) -> None:
        """Write the queue, close the files, and write map files (KML etc.) of the targets; nothing
        if no record is open.
        """
        answers = self.recorder is None or self.recorder.close()
        if self.folder is not None and answers:
            try:
                write_target_files(self.folder)
            except OSError as error:
                _log.warning("no maps of the targets: %s", error)

    def mark_incomplete(self, why: str) -> None:
        """Mark the record as incomplete and tell the operator why."""
        self.is_complete = False
        self._say_incomplete(why)
