"""Keeps the deployment in memory for a restart in flight, if its file is gone by then."""

from __future__ import annotations

import json
import os
from fcntl import F_DUPFD_CLOEXEC, fcntl
from pathlib import Path

from companion.config import CompanionConfig, load_config, parse_config, resolved
from companion.errors import ConfigError


def keep_settings(config: CompanionConfig) -> int:
    """Keep the deployment in memory; returns its file descriptor, to be passed to child processes
    (`pass_fds`) for their `settings_of`.
    """
    with open(os.memfd_create("deployment"), "wb") as file:
        # Escaped: a folder's name may be no UTF-8.
        file.write(json.dumps(config.model_dump(mode="json")).encode())
        # Beyond the standard streams, whose places are free where a program was begun without.
        return fcntl(file, F_DUPFD_CLOEXEC, 3)


def settings_of(path: Path, kept: int | None) -> tuple[CompanionConfig, str]:
    """The deployment of a file; if the file cannot be read, the kept deployment and the reason.

    kept: the descriptor returned by `keep_settings`; None at a first start, where an unreadable
    file is a `ConfigError`.
    """
    try:
        return load_config(path), ""
    except ConfigError as error:
        if kept is None:
            raise
        # Several processes have this descriptor, and one position in it.
        data = os.pread(kept, os.fstat(kept).st_size, 0)
        config = parse_config(json.loads(data), "the supervisor's deployment")
        return resolved(config, Path()), str(error)
