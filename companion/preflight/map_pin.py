"""Whether the map is the one that the deployment was made for, byte for byte."""

from __future__ import annotations

import hashlib
from pathlib import Path

from companion.errors import ConfigError
from localizer.map.cache.cache import MANIFEST_NAME
from localizer.plain_files import plain_bytes


def map_hash(cache: Path) -> str:
    """SHA-256 of the manifest, in hexadecimal.

    The manifest holds the index's hash and the index the tiles', so that it stands for all. The
    manifest itself (origin, datum, geoid separation) is guarded by nothing else. `ConfigError` if
    it cannot be read.
    """
    path = cache / MANIFEST_NAME
    try:
        return hashlib.sha256(plain_bytes(path)).hexdigest()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error


def readable_map_hash(cache: Path) -> str | None:
    """The same in flight; None where the manifest, which was open a moment ago, is not readable."""
    try:
        return map_hash(cache)
    except ConfigError:
        return None


def require_pinned(cache: Path, wanted: str | None) -> None:
    """Raises `ConfigError` when the map is another than the pinned one; None pins nothing."""
    if wanted is None:
        return
    found = map_hash(cache)
    if found != wanted.lower():
        raise ConfigError(
            f"{cache}: its manifest's SHA-256 is {found}, but map_sha256 is {wanted}: the map was "
            "altered or built again; bring back the right one, or check this one with `companion "
            "map verify` and write the hash that it prints"
        )
