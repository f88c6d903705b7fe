"""An exported .mcap read by other programs: Rerun takes it in, its schemas are Foxglove's own.

    python -m benchmarks.mcap_elsewhere FLIGHT.mcap --environment VENV [--out FILE.json]

VENV has `rerun-sdk` and `foxglove-sdk` (pip), which are no part of this project. Told: what Rerun
makes of the file (its entities and what it can draw of each), whether its check of what it made
finds errors; and for each of Foxglove's schemas in the file whether the fields (name, number, type)
are those that Foxglove's SDK publishes under the name.
"""

from __future__ import annotations

import base64
import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.named_errors import named_errors
from companion.errors import ReportError

_PATIENCE_S = 300.0
_COUNT = re.compile(r"^(\S+): (\d+)$")
# Prints {name: the SDK's schema, base64}; in VENV's own interpreter.
_PUBLISHED = """
import base64, json, foxglove.messages as messages
found = {}
for name in dir(messages):
    schema = getattr(getattr(messages, name), "get_schema", lambda: None)()
    if schema is not None:
        found[schema.name] = base64.b64encode(schema.data).decode()
print(json.dumps(found))
"""
_VERSIONS = """
from importlib.metadata import version
import json
print(json.dumps({name: version(name) for name in ("rerun-sdk", "foxglove-sdk")}))
"""


def said(command: list[str]) -> tuple[int, str]:
    """Exit status and both streams of a program."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    return done.returncode, done.stdout + done.stderr


def in_rerun(rerun: Path, file: Path, folder: Path) -> dict[str, Any]:
    """What Rerun makes of it. drawn: how often each of its components occurs."""
    made = folder / "made.rrd"
    code, text = said([str(rerun), "mcap", "convert", str(file), "-o", str(made)])
    if code != 0:
        raise ReportError(f"Rerun does not take {file}: {text.strip()[-300:]}")
    code, stats = said([str(rerun), "rrd", "stats", str(made)])
    wrong, verified = said([str(rerun), "rrd", "verify", str(made)])
    counts: dict[str, dict[str, int]] = {}
    section = ""
    for line in stats.splitlines():
        found = _COUNT.match(line)
        if found is None:
            section = line if line.strip("- ") else section
        else:
            counts.setdefault(section, {})[found[1]] = int(found[2])
    drawn = counts.get("Num chunks per component", {})
    return {
        "entities": sorted(e for e in counts.get("Num chunks per entity", {}) if "__" not in e),
        "components": {k: n for k, n in drawn.items() if not k.startswith("Mcap")},
        "check": "passed" if wrong == 0 else "failed",
        "check_said": [line for line in verified.splitlines() if line.strip()][-5:],
    }


def schemas_of(file: Path) -> dict[str, bytes]:
    """The protobuf schemas in a file: name, serialized FileDescriptorSet."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    if summary is None:
        raise ReportError(f"{file} has no index: it was not closed")
    return {s.name: s.data for s in summary.schemas.values() if s.encoding == "protobuf"}


def fields(schema: bytes, name: str) -> dict[str, list[Any]] | None:
    """Of a message: each field's number, label, type and the name of that; None if it lacks it."""
    for file in FileDescriptorSet.FromString(schema).file:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == name:
                return {f.name: [f.number, f.label, f.type, f.type_name] for f in message.field}
    return None


def against_foxglove(python: Path, file: Path) -> dict[str, str]:
    """Of each schema: same, or which fields differ."""
    code, text = said([str(python), "-c", _PUBLISHED])
    if code != 0:
        raise ReportError(f"foxglove-sdk does not tell its schemas: {text.strip()[-300:]}")
    published = {k: base64.b64decode(v) for k, v in json.loads(text).items()}
    told = {}
    for name, schema in schemas_of(file).items():
        theirs = fields(published[name], name) if name in published else None
        ours = fields(schema, name)
        if theirs is None or ours is None:
            told[name] = "not published by the SDK"
            continue
        other = sorted(k for k in theirs.keys() | ours.keys() if theirs.get(k) != ours.get(k))
        told[name] = "same" if not other else f"differs: {', '.join(other)}"
    return told


def main() -> None:
    """Ask both, print, write."""
    parser = Parser(__doc__)
    parser.add_argument("file", type=existing, help="of `companion export --mcap`")
    parser.add_argument("--environment", type=existing, required=True, help="a virtual environment")
    parser.add_argument("--out", type=output, help="JSON file")
    options = parser.parse_args()
    programs = options.environment / "bin"
    with tempfile.TemporaryDirectory() as folder:
        made = in_rerun(programs / "rerun", options.file, Path(folder))
    versions = json.loads(said([str(programs / "python"), "-c", _VERSIONS])[1])
    schemas = against_foxglove(programs / "python", options.file)
    same = sum(text == "same" for text in schemas.values())
    rows = [
        [f"Rerun {versions['rerun-sdk']}", "entities", str(len(made["entities"]))],
        ["", "its own check", made["check"]],
        [f"foxglove-sdk {versions['foxglove-sdk']}", "schemas the same as its own",
         f"{same} of {len(schemas)}"],
    ]  # fmt: skip
    for row in rows:
        print(" | ".join(row))
    if options.out is not None:
        told = {"columns": ["read by", "", "found"], "rows": rows}
        whole = told | {"rerun": made, "schemas": schemas, "versions": versions}
        options.out.write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    with named_errors():
        main()
