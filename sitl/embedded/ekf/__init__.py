"""The navigation filter, as EKF3 behaves."""
