"""Run time: what `add` brings to the running filter, effect by effect, on simulated robots that have it.

Each conversation (bench/simulate/hidden_cases.py): calibration, then the effect, the robot alone for 10 to 20 s,
to which `add` fits; from the next pause on the filter starts anew, with the profile as calibrated and with the effect
added: ERLE over 3.5 s of the robot alone, SI-SDR over the human who interrupts then.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

import numpy as np

from bench import provenance, results
from bench.metrics import mean
from bench.provenance import DIAGNOSIS
from bench.recordings import progress
from bench.simulate.conversations import read_clips, read_voices
from bench.simulate.hidden_cases import EffectConversation, make_conversation
from bench.simulate.simulated_robot import RATE
from edgefilter import Profile, calibrate, enhance
from edgefilter.diagnosis.recording import add
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.running import reach

TITLE = "What `add` brings to the running filter"
INTRODUCTION = """`edgefilter add EFFECT` fits an effect to some seconds of the robot alone and writes it into the profile. This is what
`run` makes of it on simulated robots that have the effect (by code of its own, [bench/README.md](../bench/README.md)):
calibrated before, then the effect, clear or moderate; `add` gets the robot alone for 10 to 20 s; the filter starts anew
after that, with the profile as calibrated and with the effect added. ERLE is over 3.5 s of the robot alone, from one
second on; SI-SDR over the human who interrupts then, 4.5 to 10.5 dB over the fan. The filter learns while it runs, so
what is shown is what it need not learn first. In a word: better or worse where the interval of SI-SDR, or if that says
nothing the one of ERLE, leaves out 0, of the last engine."""
ENGINES = ("linear", "ss", "crnn")
SETTLE, EDGE = RATE, RATE // 5
"""Samples of the filter's start, in which the lag is found, and before the human, that ERLE leaves out."""


def score(scene: EffectConversation, profile: Profile, engine: str) -> dict[str, float]:
    """SI-SDR over the human and ERLE over the robot alone, dB, of the filter started after the early part."""
    mic, ref = scene.mic[scene.early :], scene.ref[scene.early :]
    out = enhance(mic, ref, profile, engine=engine)
    span = slice(scene.human.start - scene.early, scene.human.stop - scene.early)
    alone = slice(SETTLE, span.start - EDGE)
    return {"si_sdr": si_sdr(out[span], scene.clean[scene.human]), "erle": erle(mic[alone], out[alone])}


def measure(scene: EffectConversation, engines: Sequence[str]) -> list[dict]:
    """A row for each engine: si_sdr and erle as calibrated, and si_sdr_more and erle_more with the effect added."""
    plain = calibrate(*scene.calibration)
    knowing, _, _ = add(plain, scene.effect, scene.mic[: scene.early], scene.ref[: scene.early])
    rows = []
    for engine in engines:
        before, after = (score(scene, profile, engine) for profile in (plain, knowing))
        more = {f"{key}_more": after[key] - before[key] for key in before}
        rows.append({"effect": scene.effect, "strength": scene.strength, "engine": engine, **before, **more})
    return rows


def verdict(rows: Sequence[Mapping]) -> str:
    """In a word, by the interval of SI-SDR, and by that of ERLE where the former says nothing."""
    for what in ("si_sdr_more", "erle_more"):
        found = mean(rows, what)
        if found["low"] is not None and (found["low"] > 0.0 or found["high"] < 0.0):
            return "better" if found["low"] > 0.0 else "worse"
    return "the same"


def tables(rows: Sequence[Mapping], engines: Sequence[str]) -> list[dict]:
    """A row an effect: what each engine gains; and what the running filter says of effects that it does not take as they are."""
    names = [effect.name for effect in EFFECTS if any(row["effect"] == effect.name for row in rows)]
    cells = []
    for name in names:
        of = [[row for row in rows if (row["effect"], row["engine"]) == (name, engine)] for engine in engines]
        gains = [mean(own, f"{what}_more") for own in of for what in ("si_sdr", "erle")]
        cells.append([name, len(of[-1]), float(np.mean([row["si_sdr"] for row in of[-1]])), *gains, verdict(of[-1])])
    columns = ["effect", "conversations", (f"{engines[-1]} before, SI-SDR dB", 1)]
    columns += [(f"{engine}: {what}", 1) for engine in engines for what in ("SI-SDR", "ERLE, dB more")]
    notes = [(effect.name, reach(effect, {p.name: p.high for p in effect.parameters})) for effect in EFFECTS]
    said = "What `add` says of an effect that the running filter does not take as it is"
    title = "Gain with the effect added, mean and 95 % interval"
    told = [[name, note] for name, note in notes if note]
    return [results.table("run-time", title, [*columns, "in a word"], cells),
            results.table("run-time-notes", said, ["effect", "NOTE"], told)]  # fmt: skip


def run(options: argparse.Namespace) -> str:
    effects, engines = options.effects.split(","), options.engines.split(",")
    for name in effects:
        find(name)
    data = {"ROBOT": [options.voices], "HUMAN": [options.speech]}
    made_with = provenance.stamp(data, [DIAGNOSIS, *engines])
    voices, people = read_voices([options.voices]), read_clips(options.speech, (3.0, 6.0))
    turns = [(effect, turn) for turn in range(options.count) for effect in effects]
    rows = []
    for effect, turn in progress(turns, "conversation"):
        rows += measure(make_conversation(options.seed, effect, turn, voices, people), engines)
    made = tables(rows, engines)
    return results.write(options.output, "run_time", TITLE, made_with, made, notes=INTRODUCTION, rows=rows)
