"""Scores that were computed once: a JSON-lines file, of which a line that was cut short harms no other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def key_of(parts: Iterable[str]) -> str:
    """One key for everything that a score depends on."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


class ScoreCache:
    """Scores by key, appended to the file at once; without a path nothing is kept."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._known: dict[str, dict] = {}
        self._cut = bool(path and path.exists() and not path.read_bytes().endswith(b"\n"))
        if path and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                with suppress(ValueError, KeyError, TypeError):  # cut short, or of an earlier version
                    entry = json.loads(line)
                    self._known[entry["key"]] = entry["score"]

    def get(self, key: str) -> dict | None:
        return self._known.get(key)

    def keep(self, key: str, score: dict) -> None:
        if self._path:
            self._known[key] = score
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as lines:
                lines.write("\n" * self._cut + json.dumps({"key": key, "score": score}) + "\n")
            self._cut = False
