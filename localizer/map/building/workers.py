"""Imports every tile of a source: here, in isolated processes, in a pool or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import cv2
import numpy as np

from localizer.errors import MapSourceError
from localizer.geometry.geo import LocalFrame, geodetic_from_ecef
from localizer.map.building.options import BuildOptions
from localizer.map.building.staging import Staging, TileRecord
from localizer.map.cache.tile import mesh_fault
from localizer.map.importers.rules import DEFAULT_RULES, ImportRules
from localizer.map.source import SourceMesh, SourceNode, TileSource

_Result = TypeVar("_Result")
_PAGE = resource.getpagesize()
_NESTED = 10_000  # calls that pickle makes of a tile tree, which may be 300 levels deep
# Formats that fetch from the network or start other programs; read when GDAL first registers its
# drivers, so before that.
_NO_DRIVERS = "HTTP,WMS,WCS,WMTS,WFS,OAPIF,OGCAPI,DAAS,EEDAI,PLMOSAIC,STACTA,STACIT,NGW,PLSCENES"


def call_in_process(
    function: Callable[..., _Result], *args: object, rules: ImportRules, what: str
) -> _Result:
    """Call a function in its own process with the limits of `rules`; returns its result or raises
    its exception. Function, arguments and result are pickled. `MapSourceError` if the process died
    or was too slow. what: for that message.
    """
    context = multiprocessing.get_context("spawn")  # OpenCV's threads do not survive a fork
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(there, rules, function, args), daemon=True)
    process.start()
    there.close()
    try:
        if not here.poll(rules.seconds):
            raise MapSourceError(
                f"{what} takes longer than {rules.seconds} s (--limit seconds=NUMBER)"
            )
        try:
            good, value = here.recv()
        except EOFError:
            process.join()
            raise MapSourceError(
                f"{what} {_death(process.exitcode, rules)}; the file is damaged, or asks for too "
                "much"
            ) from None
    finally:
        here.close()
        process.kill()
        process.join()
    if not good:
        raise value
    result: _Result = value
    return result


def _death(code: int | None, rules: ImportRules) -> str:
    if code == -signal.SIGKILL:
        return f"was killed, as the system does when memory ends (limit: {rules.memory_mb} MiB)"
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        return f"crashed ({name}; memory limit: {rules.memory_mb} MiB, --limit memory_mb=NUMBER)"
    return f"ended with exit code {code}"


def _answer(
    there: Connection, rules: ImportRules, function: Callable[..., Any], args: tuple[object, ...]
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    sys.setrecursionlimit(_NESTED)
    confine(rules)
    try:
        answer: tuple[bool, Any] = True, function(*args)
    except MemoryError:
        answer = False, MapSourceError(out_of_memory(rules))
    except Exception as error:
        answer = False, error
    there.send(answer)


def confine(rules: ImportRules) -> None:
    """Limit this process's memory, disable GDAL's network access, and end with the parent, for the
    rest of its life.
    """
    os.environ["GDAL_SKIP"] = _NO_DRIVERS
    with open("/proc/self/statm") as statm:
        used = int(statm.read().split()[5]) * _PAGE  # data and stacks
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = used + rules.memory_mb * 2**20
    if hard == resource.RLIM_INFINITY or limit < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def out_of_memory(rules: ImportRules) -> str:
    """Error text for a `MemoryError`."""
    return f"does not fit into memory ({rules.memory_mb} MiB; --limit memory_mb=NUMBER)"


def _end_with_parent() -> None:
    """End this worker when its parent is killed; otherwise it would wait for tasks forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImportJob:
    """Data of a worker besides the tile. frame: the cache's world; lift_m: added to heights. key:
    number of a source tile in the tree's order.
    """

    staged: Staging
    frame: LocalFrame
    lift_m: float
    rules: ImportRules = DEFAULT_RULES

    def run(self, key: int, tile: TileSource) -> TileRecord:
        """Import one tile; a bad one is recorded, not raised."""
        try:
            meshes = [self._to_enu(m) for m in tile.load() if len(m.faces)]
        except MapSourceError as error:
            return self.staged.reject(key, str(error))
        except MemoryError:
            return self.staged.reject(key, out_of_memory(self.rules))
        return self.staged.store(key, meshes)

    def run_in_time(self, key: int, tile: TileSource) -> TileRecord:
        """`run`, for a process of a pool only: its alarm kills the process at the time limit,
        because a hanging decoder cannot be stopped otherwise.
        """
        signal.setitimer(signal.ITIMER_REAL, self.rules.seconds)
        try:
            return self.run(key, tile)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _to_enu(self, mesh: SourceMesh) -> SourceMesh:
        positions = mesh.positions
        fault = mesh_fault(positions, mesh.uvs, mesh.faces)
        if fault is not None:
            raise MapSourceError(fault)
        if self.lift_m:
            lat, lon, _ = np.radians(geodetic_from_ecef(positions.mean(axis=0)))
            up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
            positions = positions + self.lift_m * up
        enu = self.frame.ecef_from_enu.inverse.apply(positions)
        if not np.abs(enu).max() <= 1e6:
            raise MapSourceError("lies more than 1000 km from the map's origin")
        return replace(mesh, positions=enu)


def tiles_of(root: SourceNode) -> Iterator[TileSource]:
    """Yield every tile of a tree in numbering order."""
    for node in root.walk():
        yield from node.tiles


def import_all(
    root: SourceNode, job: ImportJob, options: BuildOptions, progress: Progress
) -> dict[int, TileRecord]:
    """Records of every source tile, by its place in `tiles_of` order. Tiles that an interrupted
    build imported are not imported again. options: its processes. progress: called in the caller's
    thread with the number of finished tiles and of all tiles. `MapSourceError` if no tile has
    content.
    """
    records: dict[int, TileRecord] = {}
    todo: list[tuple[int, TileSource]] = []
    for key, tile in enumerate(tiles_of(root)):
        done = job.staged.record(key)
        if done is not None and done.error is None:
            records[key] = done
        else:
            todo.append((key, tile))
    if not records and not todo:
        raise MapSourceError("the source has no tile with content")
    total = len(records) + len(todo)
    progress(len(records), total)
    if options.scheduler is not None:
        run = _run_dask(job, todo, options.scheduler)
    elif options.is_apart:
        run = _run_pool(job, todo, options.workers or os.cpu_count() or 1)
    else:
        run = (_numbered(job, key, tile) for key, tile in todo)
    for key, record in run:
        records[key] = record
        progress(len(records), total)
    return records


def _run_dask(
    job: ImportJob, todo: list[tuple[int, TileSource]], address: str
) -> Iterator[tuple[int, TileRecord]]:
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise MapSourceError(f"a Dask scheduler needs the package distributed: {error}") from error
    with Client(address) as client:
        queue = iter(todo)
        # Few queued tiles, so that memory is bounded.
        room = 4 * max(1, sum(client.nthreads().values()))
        running = as_completed(
            [client.submit(_numbered, job, *item, pure=False) for item in islice(queue, room)]
        )
        for future in running:
            yield future.result()
            for item in islice(queue, 1):
                running.add(client.submit(_numbered, job, *item, pure=False))


def _numbered(job: ImportJob, key: int, tile: TileSource) -> tuple[int, TileRecord]:
    return key, job.run(key, tile)


def _run_pool(
    job: ImportJob, todo: list[tuple[int, TileSource]], workers: int
) -> Iterator[tuple[int, TileRecord]]:
    pending: dict[Future[TileRecord], tuple[int, TileSource]] = {}
    queue = iter(todo)
    suspects: list[tuple[int, TileSource]] = []
    pool = worker_pool(min(workers, max(1, len(todo))), job.rules)
    try:
        while True:
            # A short queue bounds memory: each pending tile is at most one decoded tile.
            for item in queue:
                pending[pool.submit(job.run_in_time, *item)] = item
                if len(pending) >= 2 * workers:
                    break
            if not pending:
                break
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            try:
                for future in done:
                    record = future.result()
                    yield pending.pop(future)[0], record
            except BrokenProcessPool:
                suspects += pending.values()
                pending.clear()
                pool.shutdown(wait=False)
                pool = worker_pool(workers, job.rules)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    for item in suspects:
        yield item[0], _run_alone(job, *item)


def _run_alone(job: ImportJob, key: int, tile: TileSource) -> TileRecord:
    """Import again, alone, a tile that was in work when a worker died, to find the cause."""
    try:
        return call_in_process(job.run, key, tile, rules=job.rules, what="its decoder")
    except MapSourceError as error:
        return job.staged.reject(key, str(error))


def worker_pool(workers: int, rules: ImportRules) -> ProcessPoolExecutor:
    """A pool of processes with the limits of `rules`, which end with this process."""
    # Not fork: OpenCV's and the caller's threads do not survive it.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        workers, mp_context=context, initializer=_start_worker, initargs=(rules,)
    )


def _start_worker(rules: ImportRules) -> None:
    cv2.setNumThreads(1)
    confine(rules)
