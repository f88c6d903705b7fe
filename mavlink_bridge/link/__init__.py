"""One MAVLink link: transports, framing, signing, clocks, the tlog."""
