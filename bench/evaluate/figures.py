"""From rows of single clips to the figures of a table: means, medians, spreads, intervals over clusters, differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bench.evaluate.clips import Clip
from bench.evaluate.systems import TRUE_LAG, System
from bench.measure.intervals import cluster_weights, ratio_interval

COMPARED = ("capped", "si_sdr")
"""By these a row is compared with the best other one: the lower, the higher."""
PLAIN = ("si_sdr", "estoi", "erle_db", "echo_mos", "human_mos")


@dataclass(frozen=True)
class Results:
    """Clips, systems and a row for each of both: rows[clip][system], None where the system has none for it."""

    clips: Sequence[Clip]
    systems: Sequence[System]
    rows: Sequence[dict[str, dict]]
    recognisers: Sequence[str] = ()

    @cached_property
    def groups(self) -> list[Group]:
        """The clips of each set and room, in their order."""
        found: dict[tuple[str, str], list[int]] = {}
        for index, clip in enumerate(self.clips):
            found.setdefault((clip.set, clip.room), []).append(index)
        return [Group(self, name, room, tuple(members)) for (name, room), members in found.items()]

    def value(self, index: int, system: str, metric: str) -> float | None:
        """A figure of one clip and system; word errors are those of the first recogniser, in %, unless `metric @ name`."""
        row = self.rows[index].get(system)
        if row is None or "absent" in row or "problem" in row:
            return None
        metric, _, recogniser = metric.partition("@")
        if metric in PLAIN or metric == "seconds":
            return row.get(metric)
        words = row.get("words", {}).get(recogniser or (self.recognisers[0] if self.recognisers else ""))
        return None if words is None else WORD_FIGURES[metric](words)


WORD_FIGURES: dict[str, Callable[[dict], float]] = {
    "wer": lambda words: 100 * words["errors"] / words["words"],
    "capped": lambda words: min(100 * words["errors"] / words["words"], 100.0),
    "errors": lambda words: words["errors"],
    "words": lambda words: words["words"],
    "insertions": lambda words: words["insertions"],
    "deletions": lambda words: words["deletions"],
}


@dataclass(frozen=True)
class Group:
    """Some clips of the results, and everything that is said of them together."""

    results: Results
    set: str
    room: str
    members: tuple[int, ...]
    _weights: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        return f"{self.set}, {self.room}"

    def part(self, members: Sequence[int]) -> Group:
        """Fewer of its clips."""
        return Group(self.results, self.set, self.room, tuple(members), self._weights)

    def column(self, system: str, metric: str) -> tuple[list[int], np.ndarray]:
        """The clips that have this figure, and the figures."""
        found = [(index, self.results.value(index, system, metric)) for index in self.members]
        kept = [(index, value) for index, value in found if value is not None]
        return [index for index, _ in kept], np.array([value for _, value in kept], np.float64)

    def weights(self, members: Sequence[int]) -> np.ndarray:
        """Draws over speakers and places, see `cluster_weights`."""
        key = tuple(members)
        if key not in self._weights:
            clips = [self.results.clips[index] for index in key]
            self._weights[key] = cluster_weights([clip.speaker for clip in clips], [clip.place for clip in clips])
        return self._weights[key]

    def _interval(
        self, members: Sequence[int], above: np.ndarray, below: np.ndarray | None = None
    ) -> tuple[float | None, float | None]:
        """See `ratio_interval`; of one clip nobody can say."""
        return (None, None) if len(members) < 2 else ratio_interval(self.weights(members), above, below)

    def mean(self, system: str, metric: str) -> dict | None:
        """mean, low, high, median, std and count of a figure; None where no clip has it."""
        members, values = self.column(system, metric)
        if not members:
            return None
        low, high = self._interval(members, values)
        spread = float(np.std(values, ddof=1)) if values.size > 1 else None
        found = {"mean": float(values.mean()), "low": low, "high": high, "median": float(np.median(values))}
        return found | {"std": spread, "count": values.size}

    def pooled(self, system: str, metric: str, recogniser: str) -> dict | None:
        """Errors of one kind over all words, %, with its interval."""
        members, counts = self.column(system, f"{metric}@{recogniser}")
        _, words = self.column(system, f"words@{recogniser}")
        if not members:
            return None
        low, high = self._interval(members, 100 * counts, words)
        return {"mean": float(100 * counts.sum() / words.sum()), "low": low, "high": high, "words": int(words.sum())}

    def difference(self, system: str, other: str, metric: str) -> dict | None:
        """By how much the figure of a system is above that of another on the same clips, with its interval."""
        (mine, ours), (theirs, others) = self.column(system, metric), self.column(other, metric)
        known = dict(zip(theirs, others, strict=True))
        both = [(index, value - known[index]) for index, value in zip(mine, ours, strict=True) if index in known]
        if not both:
            return None
        members, values = [index for index, _ in both], np.array([value for _, value in both])
        low, high = self._interval(members, values)
        return {"other": other, "difference": float(values.mean()), "low": low, "high": high, "count": values.size}

    def best(self, metric: str, besides: str = "") -> str | None:
        """The system with the best mean that a robot can have: neither a bound nor told the true lag. None without any."""
        means = {
            system.name: float(found.mean())
            for system in self.results.systems
            if system.name != besides and system.kind != "bound" and system.knows != TRUE_LAG
            if (found := self.column(system.name, metric)[1]).size
        }
        better = max if metric == "si_sdr" else min
        return better(means, key=lambda name: means[name]) if means else None

    def figures(self, system: System) -> dict:
        """All columns of one row."""
        name = system.name
        rows = [self.results.rows[index].get(name) for index in self.members]
        found: dict = {"clips": len([row for row in rows if row and "absent" not in row])}
        found["problems"] = len([row for row in rows if row and "problem" in row])
        found |= {metric: self.mean(name, metric) for metric in PLAIN}
        found["seconds_for_5s"] = self._seconds_for_5s(rows)
        found["words"] = {recogniser: self._words(name, recogniser) for recogniser in self.results.recognisers}
        found["against"] = {
            metric: self.difference(name, other, metric)
            for metric in COMPARED
            if (other := self.best(metric, besides=name))
        }
        return found

    def _words(self, name: str, recogniser: str) -> dict | None:
        mean = self.mean(name, f"wer@{recogniser}")
        if mean is None:
            return None
        capped, pooled = self.mean(name, f"capped@{recogniser}"), self.pooled(name, "errors", recogniser)
        kinds = {kind: self.pooled(name, kind, recogniser) for kind in ("insertions", "deletions")}
        return {"wer": mean, "capped": capped, "pooled": pooled, **kinds}

    @staticmethod
    def _seconds_for_5s(rows: Sequence[dict | None]) -> float | None:
        """Seconds of computing for 5 s of sound; not of rows that learn, which a robot does in another process."""
        timed = [row for row in rows if row and "seconds" in row]
        return 5 * sum(row["seconds"] for row in timed) / sum(row["duration"] for row in timed) if timed else None
