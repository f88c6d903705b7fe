"""Analysis after the flight: records, replay, shadow check."""
