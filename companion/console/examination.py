"""Runs ``companion doctor`` as a process and reads its output line by line."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

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
