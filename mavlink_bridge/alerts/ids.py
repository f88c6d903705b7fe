"""The identifiers of all alerts; records and health.json hold their values."""

from __future__ import annotations

import enum


class AlertId(enum.Enum):
    """See `mavlink_bridge.alerts.catalogue` for what each one means."""

    # integrity monitor
    VIDEO_FROZEN = "video_frozen"
    VIDEO_REPEATS = "video_repeats"
    VISION_IMU_MISMATCH = "vision_imu_mismatch"
    HEIGHT_MISMATCH = "height_mismatch"
    POSITION_JUMP = "position_jump"
    POSITION_STEP = "position_step"
    TILT_MISMATCH = "tilt_mismatch"
    GNSS_VISION_MISMATCH = "gnss_vision_mismatch"
    EKF_REJECTS_VISION = "ekf_rejects_vision"
    EKF_JUMP = "ekf_jump"
    VIDEO_TIMESTAMPS = "video_timestamps"
    HPL_OVER_LIMIT = "hpl_over_limit"
    FOCAL_LENGTH = "focal_length"
    BORESIGHT = "boresight"
    TIME_OFFSET = "time_offset"
    MONITOR_FAILED = "monitor_failed"
    FIXES_NOT_CHECKED = "fixes_not_checked"
    COMPONENT_STALLED = "component_stalled"

    # EKF source sets
    GNSS_REFUSED = "gnss_refused"

    @property
    def words(self) -> str:
        """For a table."""
        return self.value.replace("_", " ")
