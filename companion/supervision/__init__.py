"""Who notices that the flight process died: told, marked, restarted."""
