"""All clips through all systems: what is known is taken from the cache, the rest is spread over cores or a cluster."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from tqdm import tqdm

from bench.evaluate import facts as facts_of
from bench.evaluate import judge as judging
from bench.evaluate.clips import Clip
from bench.evaluate.judge import Setup, Task, judge
from bench.evaluate.systems import System
from bench.measure import real_scores, recogniser
from bench.measure.conversation import Conversation
from bench.measure.score_cache import ScoreCache, key_of
from bench.results_writer import digest
from export.spread import spread

FACTS = "facts"
JUDGES = ("speechmos", "pystoi", "jiwer", "faster-whisper", "ctranslate2", "pocketsphinx")
"""Packages whose versions change scores."""


def evaluate(
    clips: Sequence[Clip], systems: Sequence[System], setup: Setup, jobs: int, scheduler: str | None = None
) -> list[dict[str, dict]]:
    """A row for each clip and system by name, and under "facts" what the clip is like, in the order of the clips.

    What is done is kept at once in setup.cache, under everything that it depends on: clip, code, models, recognisers. So
    a run that was cut off goes on where it stopped. jobs: processes here, or a Dask scheduler's address in their place.
    """
    kept, keys = ScoreCache(setup.cache / "evaluation.jsonl"), _keys(clips, systems, setup)
    rows: list[dict[str, dict]] = [{} for _ in clips]
    tasks = []
    for index, clip in enumerate(clips):
        rows[index] = {name: found for name, key in keys[index].items() if (found := kept.get(key)) is not None}
        missing = tuple(system.name for system in systems if system.name not in rows[index])
        if missing or FACTS not in rows[index]:
            tasks.append(Task(index, clip, missing, FACTS not in rows[index]))
    if tasks:
        made = spread(judge, setup, tasks, jobs, scheduler)
        for index, found in tqdm(made, total=len(tasks), unit="clip", disable=not sys.stderr.isatty()):
            rows[index] |= found
            for name, row in found.items():
                kept.keep(keys[index][name], row)
    order = [FACTS, *(system.name for system in systems)]
    return [{name: row[name] for name in order} for row in rows]


def _keys(clips: Sequence[Clip], systems: Sequence[System], setup: Setup) -> list[dict[str, str]]:
    """Of each clip the key of each row."""
    sources = [Path(str(module.__file__)) for module in (judging, facts_of, recogniser, real_scores)]
    scoring = key_of([*(path.read_text(encoding="utf-8") for path in sources), *map(_version, JUDGES)])
    hearing = key_of(f"{name} {digest(folder)['sha256']}" for name, folder in sorted(setup.recognisers.items()))
    code = {FACTS: "", **{system.name: system.code() for system in systems}}
    found = []
    for clip in clips:
        source = clip.open()
        meta = json.dumps(source.meta, sort_keys=True) if isinstance(source, Conversation) else clip.name
        told = [source.fingerprint, meta, str(clip.text), str(clip.voices), scoring, hearing]
        found.append({name: key_of([*told, name, version]) for name, version in code.items()})
    return found


def _version(package: str) -> str:
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:
        return f"{package} not installed"
