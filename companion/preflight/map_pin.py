"""Checks that the map is exactly the one that the deployment was made for."""

from __future__ import annotations

import hashlib
from pathlib import Path

from companion.errors import ConfigError
from localizer.map.cache.cache import MANIFEST_NAME
from localizer.plain_files import plain_bytes


def map_hash(cache: Path) -> str:
    """SHA-256 of the map's manifest, in hexadecimal.

    The manifest contains the index's hash, and the index those of the tiles, so it identifies the
    whole map. `ConfigError` if it cannot be read.
    """
    path = cache / MANIFEST_NAME
    try:
        return hashlib.sha256(plain_bytes(path)).hexdigest()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error


def readable_map_hash(cache: Path) -> str | None:
    """As `map_hash`; None if the manifest cannot be read."""
    try:
        return map_hash(cache)
    except ConfigError:
        return None


def require_pinned(cache: Path, wanted: str | None) -> None:
    """`ConfigError` if the map's hash differs from `wanted`; None accepts every map."""
    if wanted is None:
        return
    found = map_hash(cache)
    if found != wanted.lower():
        raise ConfigError(
            f"{cache}: its manifest's SHA-256 is {found}, but map_sha256 is {wanted}: the map was "
            "altered or built again; bring back the right one, or check this one with `companion "
            "map verify` and write the hash that it prints"
        )
