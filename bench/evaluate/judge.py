"""One clip through all systems: what is measured of each output, and what the clip is like."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.evaluate.clips import Clip, Heard, NotHere
from bench.evaluate.facts import facts
from bench.evaluate.systems import System, catalogue
from bench.measure.real_scores import TALK_TYPES, aecmos
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Samples

ALONE_S = 5.0
"""Robot alone just before the human, over which ERLE is taken."""
MOS_S = 20.0
"""The judge of echo and human hears at most so much, to the end of the human: it was trained on clips of about 10 s."""


@dataclass(frozen=True)
class Setup:
    """What every worker is told once: where transcripts are kept, recognisers by name, further networks by name."""

    cache: Path
    recognisers: Mapping[str, Path] = field(default_factory=dict)
    networks: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """The systems by name that a clip is still to go through; facts: whether its own quantities are asked for as well."""

    index: int
    clip: Clip
    systems: tuple[str, ...]
    facts: bool = True


def judge(setup: Setup, task: Task) -> tuple[int, dict[str, dict]]:
    """The task's index, and a row for each system by its name; under "facts" what the clip is like."""
    heard, rows = Heard(task.clip), {}
    if task.facts:
        rows["facts"] = facts(task.clip, heard)
    known = _catalogue(tuple(sorted(setup.networks.items())))
    for name in task.systems:
        rows[name] = score(known[name], heard, setup)
    return task.index, rows


def score(system: System, heard: Heard, setup: Setup) -> dict:
    """All figures of one output; "absent" with the reason, or the "problem" that made it unusable.

    Raises NotHere where it is the machine that lacks something: then nothing may be kept of it.
    """
    try:
        _ = heard.source.profile, heard.mic  # made and read here, so that their time is not the system's
        heard.lent_s, began = 0.0, time.perf_counter()
        out = system.run(heard)
        seconds = time.perf_counter() - began + heard.lent_s
    except NotHere as error:
        system.missing()
        return {"absent": str(error)}
    except EdgefilterError as error:
        system.missing()
        return {"problem": str(error)}
    mic = heard.mic
    row: dict = {"duration": mic.size / SAMPLE_RATE} | ({} if system.learns else {"seconds": seconds})
    if out.size != mic.size:
        return row | {"problem": f"{out.size} samples for {mic.size}"}
    if not np.isfinite(out).all():
        return row | {"problem": "samples that are not finite"}
    return row | _alone(heard, out) | _mos(heard, out) | (_human(system, heard, out, setup) if heard.has_human else {})


def _human(system: System, heard: Heard, out: Samples, setup: Setup) -> dict:
    """What is left of the human and their words."""
    out, human = out[heard.source.span], heard.human[heard.source.span]
    if not out.any():
        return {"problem": "silence where the human speaks"}
    row: dict = {"words": {name: _words(heard.clip, out, setup, name) for name in setup.recognisers}}
    return row if system.name == "clean" else row | {"si_sdr": si_sdr(out, human), "estoi": estoi(human, out)}


def _words(clip: Clip, out: Samples, setup: Setup, name: str) -> dict:
    said = _recogniser(setup.recognisers[name], setup.cache / "transcripts.jsonl").transcribe(out)
    found = word_errors(clip.text or "", said)
    counts = {key: getattr(found, key) for key in ("errors", "words", "deletions", "insertions")}
    return counts | {"heard": said}


def _alone(heard: Heard, out: Samples) -> dict:
    """ERLE while the robot speaks alone; none where it does not."""
    if heard.has_human:
        start = heard.source.span.start
        span = slice(max(start - round(ALONE_S * SAMPLE_RATE), 0), start)
    elif heard.clip.talk == "farend":
        span = slice(None)
    else:
        return {}
    return {"erle_db": erle(heard.mic[span], out[span])} if heard.mic[span].any() and out[span].any() else {}


def _mos(heard: Heard, out: Samples) -> dict:
    """AECMOS of echo and human, 1 to 5, where its package is there."""
    mos = aecmos()
    if mos is None:
        return {}
    end = heard.source.span.stop if heard.has_human else out.size
    span = slice(max(end - round(MOS_S * SAMPLE_RATE), 0), end)
    signals = {"lpb": heard.source.read("ref"), "mic": heard.mic, "enh": out}
    said = mos({name: np.clip(x[span], -1, 1) for name, x in signals.items()}, TALK_TYPES[heard.clip.talk])  # type: ignore[operator]
    return {"echo_mos": float(said["echo_mos"]), "human_mos": float(said["deg_mos"])}


def estoi(human: Samples, out: Samples) -> float | None:
    """Extended short-time objective intelligibility (Jensen & Taal 2016); None where pystoi is not installed."""
    try:
        from pystoi import stoi
    except ImportError:
        return None
    before = np.random.get_state()
    np.random.seed(0)  # it adds a noise of its own, from the global generator
    try:
        return float(stoi(human.astype(np.float64), out.astype(np.float64), SAMPLE_RATE, extended=True))
    finally:
        np.random.set_state(before)


@lru_cache(maxsize=1)
def _catalogue(networks: tuple[tuple[str, Path], ...]) -> dict[str, System]:
    return catalogue(dict(networks))


@lru_cache(maxsize=4)
def _recogniser(folder: Path, cache: Path) -> Recogniser:
    return Recogniser(folder, cache)
