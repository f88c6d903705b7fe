"""An EKF that behaves as ArduPilot's EKF3."""
