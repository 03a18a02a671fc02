"""Scores that were computed once, by what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.results import plain


def key_of(*parts: object) -> str:
    """sha256 over the parts: arrays and bytes by their content, all else by its text."""
    whole = hashlib.sha256()
    for part in parts:
        content = part.tobytes() if isinstance(part, np.ndarray) else part
        content = content if isinstance(content, bytes) else str(content).encode()
        whole.update(f"{type(part).__name__} {len(content)} ".encode() + content)
    return whole.hexdigest()


class Cache:
    """A JSON-lines file of {"key", "value"}, appended to at once; without a folder nothing is kept.

    What a key is made of decides how long a value holds: a score that is kept under the sound that was scored outlives
    every change of code that leaves the sound equal to the bit. Several processes may append to the file; a line that
    was cut short harms no other.

    >>> cache = Cache(None)
    >>> cache.get(lambda: 2.5, "si_sdr", np.zeros(3))
    2.5
    """

    def __init__(self, folder: Path | None, name: str = "scores") -> None:
        self._path = folder / f"{name}.jsonl" if folder else None
        self._known: dict[str, Any] = {}
        if self._path and self._path.exists():
            for line in self._path.read_text(encoding="utf-8").splitlines():
                with suppress(ValueError, KeyError, TypeError):
                    entry = json.loads(line)
                    self._known[entry["key"]] = entry["value"]

    def get(self, make: Callable[[], Any], *parts: object) -> Any:
        """The value of these parts, made where it is not known; numbers that are not finite become None."""
        key = key_of(*parts)
        if key not in self._known:
            value = plain(make())
            if self._path:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with self._path.open("a", encoding="utf-8") as lines:
                    lines.write("\n" + json.dumps({"key": key, "value": value}) + "\n")
            self._known[key] = value
        return self._known[key]
