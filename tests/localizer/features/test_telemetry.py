"""Importing the localizer must not start onnxruntime's telemetry."""

import os
import subprocess
import sys


def test_no_device_id_is_written(tmp_path):
    """onnxruntime with telemetry leaves a device id and a queue in the cache folder."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("ORT_", "XDG_"))}
    environment["HOME"] = str(tmp_path)
    subprocess.run([sys.executable, "-c", "import localizer.features"], env=environment, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))
