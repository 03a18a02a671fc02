"""Rows of a long measurement kept one by one, so that a run that was cut off goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

from bench import results_writer
from bench.measure.score_cache import ScoreCache


class KeptRows:
    """A ScoreCache of rows by what they are and what they were made with.

    made_with: a results_writer.stamp; of it code, data and models count. settings: whatever else a row depends on.
    """

    def __init__(self, path: Path, made_with: Mapping, *settings: object) -> None:
        self._cache = ScoreCache(path)
        own = sorted(
            path for folder in ("simulate", "measure") for path in (Path(__file__).parents[1] / folder).glob("*.py")
        )
        bench = hashlib.sha256(b"".join(file.read_bytes() for file in own)).hexdigest()
        self._identity = [bench, *(made_with[part] for part in ("code", "data", "models")), *settings]

    def get(self, what: str, make: Callable[[], dict]) -> dict:
        """The row of that name, made where it is not known."""
        key = hashlib.sha256(results_writer.to_json({"of": [what, *self._identity]}).encode()).hexdigest()
        row = self._cache.get(key)
        if row is None:
            row = json.loads(results_writer.to_json(make()))
            self._cache.keep(key, row)
        return row
