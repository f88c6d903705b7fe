"""PX4's mode numbers, and what it does when no position is left."""

from __future__ import annotations

from sitl.embedded.control.mode import Mode
from sitl.embedded.control.modes import FlightModes
from sitl.embedded.severity import CRITICAL

# Main and sub mode of HEARTBEAT.custom_mode and of MAV_CMD_DO_SET_MODE.
NUMBERS: dict[Mode, tuple[int, int]] = {
    Mode.STABILIZE: (7, 0),
    Mode.AUTO: (4, 4),
    Mode.GUIDED: (4, 3),
    Mode.RTL: (4, 5),
    Mode.LAND: (4, 6),
}


def custom_mode(mode: Mode) -> int:
    """HEARTBEAT.custom_mode."""
    main, sub = NUMBERS[mode]
    return main << 16 | sub << 24


class Px4Modes(FlightModes):
    """PX4's modes. If the position is lost in a mode that needs it, the vehicle descends (shown as
    Land); a new position does not end the descent.
    """

    def check_ekf(self) -> None:
        """PX4's position check, called at 10 Hz: starts the descent if the position is lost."""
        if self.armed and self.mode.needs_position and not self.position_ok:
            self._enter(Mode.LAND)
            self.notify(CRITICAL, "Failsafe activated")

    @property
    def position_ok(self) -> bool:
        """Whether the position is valid, with a sigma up to COM_POS_FS_EPH (negative: any)."""
        limit = self.parameters["COM_POS_FS_EPH"]
        near = limit < 0 or self.estimator.accuracy()[0] <= limit
        return self.estimator.position_valid and near
