"""Which estimates may be used, and how bad they may be: acceptance and confirmation."""
