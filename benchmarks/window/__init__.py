"""What a sliding window of frames would be worth over single frames."""
