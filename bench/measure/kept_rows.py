"""Rows of a long measurement kept one by one, so that a run that was cut off goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

from bench import results_writer


class KeptRows:
    """A JSON-lines file of rows by what they are and what they were made with; a row is appended when it is made.

    made_with: a results_writer.stamp; of it code, data and models count. settings: whatever else a row depends on.
    """

    def __init__(self, path: Path, made_with: Mapping, *settings: object) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        own = sorted(
            path for folder in ("simulate", "measure") for path in (Path(__file__).parents[1] / folder).glob("*.py")
        )
        bench = hashlib.sha256(b"".join(file.read_bytes() for file in own)).hexdigest()
        self._identity = [bench, *(made_with[part] for part in ("code", "data", "models")), *settings]
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        found = (json.loads(line) for line in lines if line.endswith("}}"))  # the last line may have been cut off
        self._known = {entry["key"]: entry["row"] for entry in found}

    def get(self, what: str, make: Callable[[], dict]) -> dict:
        """The row of that name, made where it is not known."""
        key = hashlib.sha256(results_writer.to_json({"of": [what, *self._identity]}).encode()).hexdigest()
        if key not in self._known:
            row = results_writer.to_json({"key": key, "row": make()})
            self._known[key] = json.loads(row)["row"]
            with self._path.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(json.loads(row)) + "\n")
        return self._known[key]
