"""Which engine is fast enough on this machine: measured at the real pace on two cores, remembered, chosen with a reason."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import get_type_hints

import numpy as np
import platformdirs
import soundfile

from edgefilter import engines
from edgefilter.engines import CANDIDATES
from edgefilter.engines.base import ClipEngine, Engine
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

DEFAULT_MS = 8.0
"""Compute per hop that is allowed unless the user says otherwise: half of a 16 ms hop."""
CORES = 2
"""Most cores that a measurement may use."""
PACED = 300
"""Hops at the real pace."""
LATE_S = 0.4
"""Seconds behind the real pace after which an engine is not measured any longer."""
DEMO = Path(__file__).parent.parent / "demo_data"
"""The recordings and profiles that come with the package."""


@dataclass(frozen=True, slots=True)
class Figures:
    """One engine in the whole path, ms of compute per hop. complete: whether all PACED hops were run. model: its file's SHA-256."""

    engine: str
    model: str
    hop_ms: float
    hops: int
    complete: bool
    paced_p50_ms: float
    paced_p95_ms: float
    paced_p99_ms: float
    paced_max_ms: float

    @classmethod
    def of(cls, kept: object) -> Figures:
        """From JSON; raises ValueError where it is not what `asdict` gives."""
        kinds = get_type_hints(cls)
        if not isinstance(kept, dict) or kept.keys() != kinds.keys():
            raise ValueError(f"expected {', '.join(kinds)}")
        for name, kind in kinds.items():
            value = kept[name]
            if type(value) is not kind or (kind in (int, float) and not 0 <= value < float("inf")):
                raise ValueError(f"{name} is {str(value)[:40]!r}, expected type {kind.__name__}")
        return cls(**kept)


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

    Figures of an earlier call (`_about`, and the same model) are used again; what is missing is measured, in less than 6 s an
    engine, and once more where it is too slow, for something else may have taken the cores. say: told what is going on.
    Raises UsageError where no candidate can be made.
    """
    cores = min(CORES, len(allowed_cores()))
    about = _about(cores, profile)
    known = recall(about, say)
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
            if not fits(known[name], budget_ms) and known[name].complete:
                say(f"measuring engine {name} once more: something else may have taken the cores")
                known[name] = min(known[name], measure(engine, profile), key=lambda each: each.paced_p99_ms)
            fresh += 1
        found.append(known[name])
        if fits(known[name], budget_ms):
            break
    if not found:
        raise UsageError("no engine can be made: " + "; ".join(f"{name}: {why}" for name, why in skipped.items()))
    if fresh and (trouble := keep(about, known)):
        say(f"the measurement cannot be kept for the next time ({trouble})")
    best = found[-1] if fits(found[-1], budget_ms) else min(found, key=lambda figures: figures.paced_p99_ms)
    again = "" if fresh else " (measured before; --remeasure does it again)"
    reason = _reason(best, found, skipped, budget_ms, cores) + again
    return Choice(best.engine, fits(best, budget_ms), reason, budget_ms, cores, tuple(found), skipped, not fresh)


def fits(figures: Figures, budget_ms: float) -> bool:
    """Whether 99 of 100 hops stay within budget_ms."""
    return figures.complete and figures.paced_p99_ms <= budget_ms


def measure(engine: Engine | ClipEngine, profile: Profile | None = None, paced: int = PACED) -> Figures:
    """Run the bundled conversation through the whole path at the real pace, held to two cores."""
    hop = engine.stft.hop
    hops, stream = scene(hop), Stream(engine, profile)
    with held_to(CORES):
        pace(stream, hops, 32, period_s=0.0)  # not counted
        took = pace(stream, hops, paced)
    times = (float(each) for each in np.percentile(took, (50, 95, 99, 100)))
    return Figures(engine.name, _model(engine), 1000 * hop / SAMPLE_RATE, len(took), len(took) == paced, *times)


def pace(
    stream: Stream, hops: Iterator[tuple[Samples, Samples]], count: int, period_s: float | None = None
) -> list[float]:
    """Compute time, ms, of count hops, or fewer where it falls LATE_S behind; one begins every period_s, None: its length."""
    period_s = stream.engine.stft.hop / SAMPLE_RATE if period_s is None else period_s
    took: list[float] = []
    began = time.perf_counter()
    while len(took) < count and (early := began + len(took) * period_s - time.perf_counter()) > -LATE_S:
        time.sleep(max(0.0, early))
        mic, ref = next(hops)
        start = time.perf_counter()
        stream.process(mic, ref)
        took.append(1000 * (time.perf_counter() - start))
    return took


@contextmanager
def held_to(cores: int) -> Iterator[None]:
    """Let this thread run on the first so many of its cores only, where the system can do that."""
    before = allowed_cores()
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    os.sched_setaffinity(0, sorted(before)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def allowed_cores() -> set[int]:
    """Numbers of the cores that this process may use."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def scene(hop: int) -> Iterator[tuple[Samples, Samples]]:
    """The bundled conversation hop by hop, over and over."""
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    while True:
        for at in range(0, mic.size - hop + 1, hop):
            yield mic[at : at + hop], ref[at : at + hop]


def _model(engine: Engine | ClipEngine) -> str:
    return getattr(getattr(engine, "model", None), "sha256", "")


def _about(cores: int, profile: Profile | None) -> dict[str, object]:
    """What timings depend on: machine, versions, cores, and the path's length and effects."""
    found: dict[str, object] = {"machine": platform.node(), "processor": processor(), "cores": os.cpu_count()}
    if profile:
        found |= {"taps": profile.echo.impulse_response.size, "effects": [name for name, _ in profile.echo.effects]}
    return {**found, **versions(("edgefilter", "numpy", "scipy", "onnxruntime")), "held_to": cores}


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Of Python and of each package, "none" where it is not installed."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "none"
    return found


def processor() -> str:
    """Name of the processor as the system knows it."""
    lines = []
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.lower().startswith("model name")]
    return names[0] if names else platform.processor()


def timings() -> Path:
    """The file in which measurements are kept, in the user's cache folder by the platform's rules."""
    return platformdirs.user_cache_path("edgefilter", appauthor=False, opinion=False) / "timings.json"


def recall(about: Mapping[str, object], say: Callable[[str], None]) -> dict[str, Figures]:
    """Engine -> figures as kept by `keep` for exactly this description; none where they are damaged, and say is told."""
    try:
        entry = _kept().get(_key(about), {})
        if not isinstance(entry, dict):
            raise ValueError("its entry for this machine holds no engines")
        return {name: Figures.of(figures) for name, figures in entry.items()}
    except (OSError, ValueError) as error:
        say(f"the measurements kept in {timings()} are not used: {error}")
        return {}


def keep(about: Mapping[str, object], figures: Mapping[str, Figures]) -> str | None:
    """Write figures, atomically; returns why that was impossible, None when it was done."""
    everything: dict = {}
    with suppress(OSError, ValueError):
        everything = _kept()
    everything[_key(about)] = {name: asdict(each) for name, each in figures.items()}
    draft = timings().with_suffix(f".{os.getpid()}")
    try:
        draft.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(json.dumps(everything, indent=1) + "\n", encoding="utf-8")
        draft.replace(timings())
    except OSError as error:
        return f"{draft.parent}: {error.strerror}"
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
    return None


def forget() -> None:
    """Remove all that was measured."""
    timings().unlink(missing_ok=True)


def _kept() -> dict:
    """All that is kept, nothing where there is no file; raises OSError, or ValueError for what is no JSON object."""
    try:
        found = json.loads(timings().read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError):
        raise ValueError("it is not JSON") from None
    if not isinstance(found, dict):
        raise ValueError(f"it holds a JSON {type(found).__name__}, expected an object")
    return found


def _key(about: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def _reason(best: Figures, found: Sequence[Figures], skipped: dict[str, str], budget_ms: float, cores: int) -> str:
    """One sentence: the figures, and what speaks against the better engines."""
    others = [f"{figures.engine} needs {_needs(figures)}" for figures in found if figures is not best]
    others += [f"{name} cannot be used ({why})" for name, why in skipped.items()]
    against = "".join(f"; {text}" for text in others)
    measured = f"p99 {_needs(best)} per {best.hop_ms:.0f} ms hop on {cores} cores (p50 {best.paced_p50_ms:.1f} ms)"
    if fits(best, budget_ms):
        return f"auto: best engine within {budget_ms:g} ms, {measured}{against}"
    wish = "a faster processor"
    if best.complete and best.paced_p99_ms < best.hop_ms:
        wish = f"--budget-ms {np.ceil(best.paced_p99_ms):.0f}"
    failure = f"auto: no engine keeps to {budget_ms:g} ms; {best.engine} is the cheapest, {measured}{against}"
    return f"{failure}; {wish}, a free core or fewer programs beside it would help"


def _needs(figures: Figures) -> str:
    if figures.complete:
        return f"{figures.paced_p99_ms:.1f} ms"
    return f"more than the hop ({figures.paced_p50_ms:.0f} ms)"
