"""Compute time of the running filter: counts late hops, and changes to a cheaper or a better engine."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from edgefilter.engines.combined import Fallback
from edgefilter.filter.timing import Histogram
from edgefilter.types import SAMPLE_RATE, DeadlineStats, EventKind

OVERLOADED = 0.25
"""Part of the last second of hops over the budget at which the load counts as sustained: a single stall is shorter."""
CALM = 0.01
"""Part of the hops over the budget up to which the machine has recovered: the budget is promised for 99 of 100."""
PATIENCE_S, MOST_PATIENCE_S = 10.0, 160.0
"""Calm seconds before a better engine is tried; doubled, up to the most, where one is left before it has run as long."""


class Stepping:
    """Watches the compute time of each hop of one stream.

    A hop misses its deadline where its compute took longer than the hop lasts; it is over the budget where it took
    longer than budget_ms, or than the hop. Where OVERLOADED of the last second are over the budget, the fallback is asked
    for the next cheaper engine, and after PATIENCE_S of calm for the next better one. fallback: None to count only.
    """

    def __init__(
        self,
        hop: int,
        fallback: Fallback | None = None,
        budget_ms: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.hop_ms = 1000 * hop / SAMPLE_RATE
        self.budget_ms = self.hop_ms if budget_ms is None else min(budget_ms, self.hop_ms)
        self.fallback = fallback
        self.clock = clock
        self._window = self._hops(1.0)
        self.reset()

    def reset(self) -> None:
        """As before the first hop, at the best engine."""
        self.times = Histogram()
        self.missed = self.over_budget = self.steps = 0
        self.behind_ms = self.most_behind_ms = 0.0
        self._recent: deque[bool] = deque(maxlen=self._window)
        self._calm_hops = self._calm_late = 0
        self._patience_s = PATIENCE_S
        self._since_up: int | None = None
        self._told = False
        if self.fallback:
            self.fallback.wanted = 0

    def note(self, compute_s: float) -> tuple[EventKind, str] | None:
        """Take the compute time of one hop; return what happened and in which words, if anything did."""
        ms = 1000 * compute_s
        self.times.add(ms)
        late = ms > self.budget_ms
        self.missed += ms > self.hop_ms
        self.over_budget += late
        self.behind_ms = max(0.0, self.behind_ms + ms - self.hop_ms)
        self.most_behind_ms = max(self.most_behind_ms, self.behind_ms)
        self._recent.append(late)
        self._calm_hops += 1
        self._calm_late += late
        if self._since_up is not None:
            self._since_up += 1
        if sum(self._recent) >= OVERLOADED * self._window:
            return self._down()
        return self._up()

    def stats(self) -> DeadlineStats:
        """Ready for JSON: times per hop, missed deadlines, hops over budget, how far behind it was at worst."""
        return {
            "hop_ms": self.hop_ms,
            "budget_ms": self.budget_ms,
            "hops": self.times.count,
            "missed_deadlines": self.missed,
            "over_budget": self.over_budget,
            "most_behind_ms": self.most_behind_ms,
            "steps": self.steps,
            "compute": self.times.to_dict(),
        }

    def _hops(self, seconds: float) -> int:
        return round(1000 * seconds / self.hop_ms)

    def _down(self) -> tuple[EventKind, str] | None:
        why = f"{sum(self._recent)} of the last {len(self._recent)} hops took more than {self.budget_ms:.1f} ms"
        self._recent.clear()
        self._calm_hops = self._calm_late = 0
        if self.fallback is None or self.fallback.wanted == len(self.fallback.engines) - 1:
            first, self._told = not self._told, True
            return ("overloaded", f"{why} and there is no cheaper engine to step down to") if first else None
        if self._since_up is not None:
            failed = self._since_up < self._hops(self._patience_s)
            self._patience_s = min(2 * self._patience_s, MOST_PATIENCE_S) if failed else PATIENCE_S
        self._since_up = None
        return "stepped_down", f"{self._move(self.fallback, 1)}: {why}"

    def _up(self) -> tuple[EventKind, str] | None:
        if self.fallback is None or self.fallback.wanted == 0:
            return None
        calm = self._hops(self._patience_s)
        if self._calm_late > CALM * calm:
            self._calm_hops = self._calm_late = 0
        if self._calm_hops < calm:
            return None
        self._calm_hops = self._calm_late = self._since_up = 0
        return "stepped_up", f"{self._move(self.fallback, -1)}: {self._patience_s:.0f} s within {self.budget_ms:.1f} ms"

    def _move(self, fallback: Fallback, by: int) -> str:
        before = fallback.engines[fallback.wanted].name
        fallback.wanted += by
        self.steps += 1
        return f"from {before} to {fallback.engines[fallback.wanted].name}"
