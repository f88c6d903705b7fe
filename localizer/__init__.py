"""The PiLoT algorithm as a library: no MAVLink, no video transport, no application."""
