"""The same aircraft with PX4's interface: its modes, parameters, messages and position aiding.

From PX4's public source and documentation (EKF2's `aux_global_position`, `external_vision` and
`gps_control`, November 2026), written anew. Shared with PX4: HEARTBEAT and mode numbers, parameters
that travel as bytes, TIMESYNC asked for by the autopilot, what ODOMETRY, VISION_POSITION_ESTIMATE
and GLOBAL_POSITION_SENSOR must hold, gates and timeouts of GNSS, external vision and the first
auxiliary position, and Descend when no position is left.

Not PX4's: the inertial filter, the control loops and the mission (those of the ArduPilot model),
EVENT, the other instances of the auxiliary position, heights from anything but the barometer, and a
pilot's sticks: COM_POSCTL_NAVL other than 1 has no effect. Hold takes the part of GUIDED, take-off
included. SIM_* and SIM_STATE are the simulator's. It is no PX4 SITL: a flight on it shows that the
bridge speaks PX4's dialect, not what PX4 does.
"""
