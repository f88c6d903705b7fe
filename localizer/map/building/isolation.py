"""Calls a function in its own process: crashes, hangs and memory exhaustion become named errors."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from localizer.errors import MapSourceError
from localizer.map.importers.rules import ImportRules

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
