"""The PiLoT algorithm as a library: no MAVLink, no video transport, no application."""

import os

# onnxruntime from 1.31 on reports its use and a device id to its maker, from its import on; only
# this variable, set before that, stops it. An aircraft's computer talks to nobody unasked.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
