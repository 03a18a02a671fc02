"""Which engine this machine can bear: the real path measured at the real pace on two cores, and the choice with its reason."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_type_hints

import numpy as np
import soundfile

from edgefilter import engines
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.engines.ladder import CANDIDATES
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter import budget_cache
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

DEFAULT_MS = 8.0
"""Compute per hop that is allowed unless the user says otherwise: half of a 16 ms hop."""
CORES = 2
WARM_UP, PACED = 32, 300
"""Hops that are not counted, and hops at the real pace; as many again back to back."""
WARM_UP_S, PACED_S, AT_ONCE_S = 0.2, 5.2, 0.4
"""Longest time for each kind of hops, seconds."""
PASSING = 0.5
"""Share of the budget within which the median of an engine whose p99 is beyond it may be another program's fault: it is
measured a second time. Where it was not, the filter steps down while it runs."""
AGAIN = " (measured before; --remeasure does it again)"
SCENE = Path(__file__).parents[1] / "demo_data"


@dataclass(frozen=True, slots=True)
class Figures:
    """One engine in the whole path: ms of compute per hop. complete: all PACED hops could be run in time.

    model: SHA-256 of the engine's model file, empty where it has none.
    """

    engine: str
    model: str
    hop_ms: float
    hops: int
    complete: bool
    paced_p50_ms: float
    paced_p95_ms: float
    paced_p99_ms: float
    paced_max_ms: float
    at_once_p50_ms: float
    at_once_p99_ms: float


KINDS = get_type_hints(Figures)


@dataclass(frozen=True, slots=True)
class Choice:
    """The engine to run, whether it fits the budget, a sentence that says why, and what that rests on.

    skipped: candidates that could not be made, and why. remembered: all figures are from an earlier run.
    """

    engine: str
    fits: bool
    reason: str
    budget_ms: float
    cores: int
    figures: tuple[Figures, ...]
    skipped: dict[str, str]
    remembered: bool

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return asdict(self)


def choose(
    budget_ms: float = DEFAULT_MS,
    profile: Profile | None = None,
    candidates: Sequence[str] = CANDIDATES,
    say: Callable[[str], None] = lambda text: None,
) -> Choice:
    """The first of candidates, best first, whose p99 compute per hop at the real pace is within budget_ms.

    Figures of an earlier call on this machine, with these versions, models, cores and this length of path, are used
    again; what is missing is measured, in less than 6 s an engine, twice where a passing load may have slowed it. say:
    told what is going on. Raises UsageError where no candidate can be made.
    """
    cores = min(CORES, len(_allowed()))
    about = budget_cache.describe({"held_to": cores, "taps": _taps(profile), "effects": _effects(profile)})
    known = {name: Figures(**kept) for name, kept in budget_cache.recall(about, KINDS, say).items()}
    found: list[Figures] = []
    skipped: dict[str, str] = {}
    fresh = 0
    for name in candidates:
        try:
            engine = engines.create(name, profile)
        except EdgefilterError as error:
            skipped[name] = str(error)
            continue
        if name not in known or known[name].model != _model(engine):
            say(f"measuring engine {name} at the real pace on {cores} cores, about 5 s ...")
            known[name] = measure(engine, profile)
            if not fits(known[name], budget_ms) and known[name].paced_p50_ms <= PASSING * budget_ms:
                say(f"measuring engine {name} once more: something else may have taken the cores")
                known[name] = min(known[name], measure(engine, profile), key=lambda each: each.paced_p99_ms)
            fresh += 1
        found.append(known[name])
        if fits(known[name], budget_ms):
            break
    if not found:
        raise UsageError("no engine can be made: " + "; ".join(f"{name}: {why}" for name, why in skipped.items()))
    if fresh and (trouble := budget_cache.keep(about, {name: asdict(figures) for name, figures in known.items()})):
        say(f"the measurement cannot be kept for the next time ({trouble})")
    best = found[-1] if fits(found[-1], budget_ms) else min(found, key=lambda figures: figures.paced_p99_ms)
    reason = _reason(best, found, skipped, budget_ms, cores) + ("" if fresh else AGAIN)
    return Choice(best.engine, fits(best, budget_ms), reason, budget_ms, cores, tuple(found), skipped, not fresh)


def fits(figures: Figures, budget_ms: float) -> bool:
    """Whether 99 of 100 hops stay within budget_ms."""
    return figures.complete and figures.paced_p99_ms <= budget_ms


def measure(engine: Engine | ClipEngine, profile: Profile | None = None, paced: int = PACED) -> Figures:
    """Run the bundled conversation through the whole path, first paced at the real hop, then back to back, held to two cores."""
    hop = engine.stft.hop
    hops = _scene(hop)
    stream = Stream(engine, profile)
    with held_to(CORES):
        pace(stream, hops, WARM_UP, WARM_UP_S, period_s=0.0)
        slow = pace(stream, hops, paced, PACED_S)
        at_once = pace(stream, hops, paced, AT_ONCE_S, period_s=0.0)
    times = (*np.percentile(slow, (50, 95, 99, 100)), *np.percentile(at_once, (50, 99)))
    return Figures(
        engine.name, _model(engine), 1000 * hop / SAMPLE_RATE, len(slow), len(slow) == paced, *map(float, times)
    )


def pace(
    stream: Stream, hops: Iterator[tuple[Samples, Samples]], count: int, limit_s: float, period_s: float | None = None
) -> list[float]:
    """Ms that each of count hops took, one begun every period_s (None: the hop's own length), fewer where limit_s is over first."""
    period_s = stream.engine.stft.hop / SAMPLE_RATE if period_s is None else period_s
    took: list[float] = []
    began = time.perf_counter()
    while len(took) < count and (not took or time.perf_counter() - began < limit_s):
        time.sleep(max(0.0, began + len(took) * period_s - time.perf_counter()))
        mic, ref = next(hops)
        start = time.perf_counter()
        stream.process(mic, ref)
        took.append(1000 * (time.perf_counter() - start))
    return took


@contextmanager
def held_to(cores: int) -> Iterator[None]:
    """Let this thread run on the first so many of its cores only, where the system can do that."""
    before = _allowed()
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    os.sched_setaffinity(0, sorted(before)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _allowed() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def _scene(hop: int) -> Iterator[tuple[Samples, Samples]]:
    """The bundled conversation hop by hop, over and over."""
    mic, ref = (soundfile.read(SCENE / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    while True:
        for at in range(0, mic.size - hop + 1, hop):
            yield mic[at : at + hop], ref[at : at + hop]


def _model(engine: Engine | ClipEngine) -> str:
    return getattr(getattr(engine, "model", None), "sha256", "")


def _taps(profile: Profile | None) -> int | None:
    return None if profile is None else int(profile.echo.impulse_response.size)


def _effects(profile: Profile | None) -> list[str]:
    return [] if profile is None else [name for name, _ in profile.echo.effects]


def _reason(best: Figures, found: Sequence[Figures], skipped: dict[str, str], budget_ms: float, cores: int) -> str:
    """One sentence: the figures, and what speaks against the better engines."""
    others = [f"{figures.engine} needs {_needs(figures)}" for figures in found if figures is not best]
    others += [f"{name} cannot be used ({why})" for name, why in skipped.items()]
    against = "".join(f"; {text}" for text in others)
    typical = f"p50 {best.paced_p50_ms:.1f} ms, back to back {best.at_once_p50_ms:.1f} ms"
    measured = f"p99 {_needs(best)} per {best.hop_ms:.0f} ms hop on {cores} cores ({typical})"
    if fits(best, budget_ms):
        return f"auto: best engine within {budget_ms:g} ms, {measured}{against}"
    wish = (
        f"--budget-ms {np.ceil(best.paced_p99_ms):.0f}"
        if best.complete and best.paced_p99_ms < best.hop_ms
        else "a faster processor"
    )
    failure = f"auto: no engine keeps to {budget_ms:g} ms; {best.engine} is the cheapest, {measured}{against}"
    return f"{failure}; {wish}, a free core or fewer programs beside it would help"


def _needs(figures: Figures) -> str:
    return (
        f"{figures.paced_p99_ms:.1f} ms" if figures.complete else f"more than the hop ({figures.paced_p50_ms:.0f} ms)"
    )
