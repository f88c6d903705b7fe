"""Checks key files and record folders without creating them."""

from __future__ import annotations

import os
from pathlib import Path

from companion.config import CompanionConfig
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.signing import load_key
from mavlink_bridge.preflight.rules import DoctorFinding


def check_places(config: CompanionConfig) -> list[DoctorFinding]:
    """Findings on the folders, signing keys and console files that the configuration names: a
    flight would not start if one cannot be written or read.
    """
    bridge = config.bridge
    written = {"bridge.tlog": bridge.tlog}
    faults = []
    if config.record is not None:
        faults.append(_unwritable("record.folder", config.record.folder))
    if config.state_dir is not None:
        faults.append(_unwritable("state_dir", config.state_dir))
    faults += [_no_file(key, path) for key, path in written.items() if path is not None]
    keys = {"bridge.signing": bridge.signing, "bridge.ground_signing": bridge.ground_signing}
    for key, signing in keys.items():
        if signing is not None:
            try:
                load_key(signing.key_file)
            except BridgeError as error:
                faults.append(f"{key}: {error}")
    if config.console is not None:
        page = config.console
        read = {"token_file": page.token_file, "tls_certificate": page.tls_certificate}
        for key, path in (read | {"tls_key": page.tls_key}).items():
            if path is not None and not path.is_file():
                faults.append(f"console.{key} {path}: is no file")
    needed = "folders to write to, keys to read"
    return [
        DoctorFinding("files", "unusable", needed, fault, False, True) for fault in faults if fault
    ]


def _no_file(key: str, path: Path) -> str:
    """Why the file cannot be created or written; "" if it can."""
    try:
        if path.is_dir():
            return f"{key} {path}: a folder, not a file"
    except OSError as error:
        return f"{key} {path}: {error.strerror}"
    return _unwritable(key, path.parent)


def _unwritable(key: str, folder: Path) -> str:
    """Why the folder, or its nearest existing parent, cannot be written; "" if it can."""
    try:
        place = folder
        while not place.exists() and place != place.parent:
            place = place.parent
        if not place.is_dir():
            return f"{key} {folder}: {place} is not a folder"
        if not os.access(place, os.W_OK | os.X_OK):
            return f"{key} {folder}: {place} cannot be written"
    except OSError as error:
        return f"{key} {folder}: {error.strerror}"
    return ""
