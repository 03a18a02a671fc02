"""Clips through systems: what is known is taken from the cache, the rest is spread over cores or a cluster."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from tqdm import tqdm

from bench import metrics, recordings, results, systems
from bench.cache import Cache
from bench.metrics import CachedMetrics, facts
from bench.recogniser import Recogniser
from bench.recordings import Clip, NotHere
from bench.spread import spread
from edgefilter.errors import EdgefilterError
from edgefilter.filter.budget import versions

SCORING = ("speechmos", "pystoi", "jiwer", "faster-whisper", "ctranslate2")
"""Packages whose versions change scores."""


@dataclass(frozen=True)
class Setup:
    """What every worker is told once: where scores are kept, the recognisers' folders, further networks by name."""

    cache: Path | None
    whisper: Path | None = None
    networks: tuple[tuple[str, Path], ...] = ()
    second_whisper: Path | None = None


def run(
    clips: Sequence[Clip], rows: Sequence[systems.System], setup: Setup, jobs: int = 1, scheduler: str | None = None
) -> list[dict]:
    """A row for each clip and system: what the clip is, and what `metrics.score` gives.

    "absent" with the reason, or the "problem" that made an output unusable, in place of figures. What is done is kept at
    once: a row under its clip and code, a transcript or AECMOS under the sound itself.
    """
    tasks = [(clip, tuple(one.name for one in rows)) for clip in clips]
    if jobs == 1 and not scheduler:
        made = (_work(setup, task) for task in tasks)
    else:
        made = spread(_work, setup, tasks, jobs, scheduler)
    done = dict(tqdm(made, total=len(tasks), unit="clip", disable=not sys.stderr.isatty()))
    return [row for clip in clips for row in done[clip.name]]


def cached_metrics(setup: Setup) -> CachedMetrics:
    kept = Cache(setup.cache, "by_sound")
    folders = setup.whisper, setup.second_whisper
    return CachedMetrics(kept, *(Recogniser(folder, kept) if folder else None for folder in folders))


def _work(setup: Setup, task: tuple[Clip, tuple[str, ...]]) -> tuple[str, list[dict]]:
    (clip, names), (known, kept, cached) = task, _opened(setup)
    about = {"set": clip.set, "room": clip.room, "clip": clip.name, "speaker": clip.speaker, "place": clip.place}
    about |= {"text": clip.text, "facts": kept.get(lambda: facts(clip), "facts", clip.fingerprint, _scoring())}
    rows = []
    for name in names:
        system = known[name]
        key = (
            clip.fingerprint,
            clip.talk,
            str(clip.text),
            str(clip.voices),
            name,
            _code(system),
            _scoring(),
            cached.asked,
        )
        rows.append({**about, "system": name, **kept.get(lambda system=system: one(clip, system, cached), *key)})
    return clip.name, rows


def one(clip: Clip, system: systems.System, cached: CachedMetrics) -> dict:
    """All figures of one output. Raises NotHere where it is the machine that lacks something: nothing is kept of that."""
    try:
        _ = clip.profile, clip.mic  # made and read here, so that their time is not the system's
        clip.lent_s, began = 0.0, time.perf_counter()
        output = system.run(clip)
        seconds = time.perf_counter() - began + clip.lent_s
    except NotHere as error:
        system.missing()
        return {"absent": str(error)}
    except EdgefilterError as error:
        system.missing()
        return {"problem": str(error)}
    timed = {} if system.learns else {"seconds": seconds}  # a robot learns in another process
    return timed | metrics.score(clip, output, cached)


@lru_cache(maxsize=1)
def _opened(setup: Setup) -> tuple[dict[str, systems.System], Cache, CachedMetrics]:
    return systems.catalogue(dict(setup.networks)), Cache(setup.cache, "rows"), cached_metrics(setup)


@lru_cache(maxsize=64)
def _code(system: systems.System) -> str:
    return system.code() + results.code_digest([Path(str(systems.__file__)), Path(str(recordings.__file__))])


@lru_cache(maxsize=1)
def _scoring() -> str:
    return results.code_digest([Path(str(metrics.__file__))]) + str(versions(SCORING))
