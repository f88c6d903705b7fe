"""Visual odometry: its drift, and whether its covariance is honest."""
