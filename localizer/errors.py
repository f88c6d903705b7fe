"""Named errors of the localizer: each says what is wrong, where, and what to do."""

from __future__ import annotations


class LocalizerError(Exception):
    """Base of the localizer's errors."""


class GeoreferenceError(LocalizerError):
    """A datum, CRS or coordinate that is missing, unknown or out of range."""


class CameraError(LocalizerError):
    """A camera model that is not physical, or that contradicts its images."""


class PoseFileError(LocalizerError):
    """A pose file that cannot be read; names file and line."""


class MapError(LocalizerError):
    """Base of the errors of a map or its tile cache."""


class MapSourceError(MapError):
    """A map source (tileset, mesh, raster) that cannot be imported."""


class MapFetchError(MapError):
    """A map service that refuses, a source that is not known, or a limit that was reached."""


class MapCacheError(MapError):
    """A tile cache that is missing, incomplete, corrupt or of another format version."""


class OutsideMapError(MapError):
    """A pose whose view does not meet the map."""


class MapLoadingError(OutsideMapError):
    """A view whose tiles are not in memory yet; they are being loaded."""


class RenderError(LocalizerError):
    """A renderer that is not available, or that is used by the wrong thread."""


class ModelError(LocalizerError):
    """A feature network that is missing, corrupt or of the wrong shape."""


class BackendError(LocalizerError):
    """A device that registers is not there, or failed; the CPU takes over."""


class SequenceError(LocalizerError):
    """An evaluation sequence that lacks a part or contradicts itself."""


class GreyRangeError(LocalizerError):
    """16-bit grey without a stated range of black and white."""


class DeviceArrayError(LocalizerError):
    """An array in GPU memory that the kernels cannot read in place."""


class OdometryError(LocalizerError):
    """Odometry was called without a start pose."""
