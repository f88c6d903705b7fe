"""One MAVLink link: transports, framing, signing, clocks, .tlog."""
