"""The deployment file in the console: help, checks, replacement, and `companion doctor`."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from companion.config import CompanionConfig, load_config
from companion.errors import ConfigError, redacted
from companion.settings_file import nested_models, settable_fields
from localizer.plain_files import plain_text

_LONGEST_S = 180.0
_MOST_LINES = 400


class Examination:
    """Runs `companion doctor` as a process, one at a time."""

    def __init__(self, deployment: Path) -> None:
        self._deployment = deployment
        self._task: asyncio.Task[None] | None = None
        self._lines: list[str] = []
        self._code: int | None = None

    def report(self) -> dict[str, Any]:
        """The output so far. code: exit code of the doctor, None while it runs or before the first
        run.
        """
        running = self._task is not None and not self._task.done()
        return {"running": running, "lines": list(self._lines), "code": self._code}

    def begin(self, beside_flight: bool) -> bool:
        """Start the doctor in the running event loop, for at most 180 s; False if it is running.
        The output of the last run is forgotten. beside_flight: a flight uses the vehicle and the
        feed, which are not checked then.
        """
        if self._task is not None and not self._task.done():
            return False
        self._lines, self._code = [], None
        self._task = asyncio.get_running_loop().create_task(self._run(beside_flight))
        return True

    async def _run(self, beside_flight: bool) -> None:
        options = ["--beside-flight"] if beside_flight else []
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "companion", "doctor", str(self._deployment), *options,
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT, env=os.environ | {"COLUMNS": "100"},
        )  # fmt: skip
        assert process.stdout is not None
        try:
            await asyncio.wait_for(self._read(process.stdout), _LONGEST_S)
            self._code = await process.wait()
        except asyncio.TimeoutError:
            self._lines.append(f"ended: it took more than {_LONGEST_S:.0f} s")
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()

    async def _read(self, stream: asyncio.StreamReader) -> None:
        async for line in stream:
            if len(self._lines) < _MOST_LINES:
                self._lines.append(line.decode("utf-8", "replace").rstrip())


_MOST_BYTES = 64 << 10


def read_for_page(path: Path, editable: bool) -> dict[str, Any]:
    """The file's text and the help for its keys. editable: whether the reader may change the file;
    otherwise credentials are hidden. `ConfigError` if the file cannot be read.
    """
    try:
        text = plain_text(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    return {
        "path": str(path),
        "text": text if editable else redacted(text),
        "editable": editable,
        "help": [{"key": k, "default": d, "text": t} for k, d, t in help_lines(CompanionConfig)],
    }


def check(path: Path, text: str) -> CompanionConfig:
    """Check a text as the deployment file at `path`, and return its configuration; `ConfigError`
    names what is wrong.

    The text is read from a temporary file beside the real one, because relative paths begin there.
    """
    if len(text.encode()) > _MOST_BYTES:
        raise ConfigError(f"over {_MOST_BYTES >> 10} KiB; that is no deployment")
    with _temporary_file(path, text) as trial:
        try:
            return load_config(trial)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(trial), path.name)) from error


def replace(path: Path, text: str) -> Path:
    """Write a valid text into the existing deployment file; returns the path of the copy of the old
    one, NAME.TIME.old. `ConfigError` if the text is not valid or cannot be written.
    """
    check(path, text)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    kept = path.with_name(f"{path.name}.{stamp}.old")
    number = 2
    while kept.exists():
        kept = path.with_name(f"{path.name}.{stamp}-{number}.old")
        number += 1
    try:
        mode = path.stat().st_mode & 0o777
        kept.write_bytes(path.read_bytes())
        kept.chmod(mode)
        with _temporary_file(path, text) as fresh:
            fresh.chmod(mode)
            os.replace(fresh, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error
    return kept


def help_lines(model: type[BaseModel], where: str = "") -> list[tuple[str, str, str]]:
    """(key, default, description) of every setting of the model; keys begin with `where`."""
    lines = []
    for name, field in settable_fields(model).items():
        nested = nested_models(field.annotation)
        key = f"{where}{name}"
        if nested:
            lines += [line for m in nested for line in help_lines(m, f"{key}.")]
            continue
        default = "needed" if field.is_required() else str(field.default)
        lines.append((key, default, field.description or ""))
    return lines


@contextlib.contextmanager
def _temporary_file(path: Path, text: str) -> Iterator[Path]:
    """A temporary file with that text in the same folder."""
    try:
        number, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".yaml", dir=path.parent)
    except OSError as error:
        raise ConfigError(f"{path.parent}: cannot be written: {error}") from error
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)
