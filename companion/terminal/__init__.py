"""What a person sees of a running command: its log, its steps, its progress."""
