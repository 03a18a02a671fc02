"""What `add` brings to the running filter, effect by effect: SI-SDR and ERLE before and after, on robots that have it.

    python -m bench.measure.effects_at_run_time --voices robot/test --speech human/test --seed 41 --count 10 \
        --output bench/results/effects_at_run_time --page docs/effects_at_run_time.md

Each conversation (bench/simulate/effect_conversations.py): calibration, then the effect, the robot alone for 10 to
20 s, to which `add` fits; from the next pause on the filter starts anew, with the profile as calibrated and with
the effect added: ERLE over 3.5 s of the robot alone, SI-SDR over the human who interrupts then.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench import results_writer
from bench.measure.intervals import interval
from bench.simulate.conversations import Clip, read_clips
from bench.simulate.effect_conversations import EFFECTS as SIMULATED
from bench.simulate.effect_conversations import EffectConversation, make
from bench.simulate.simulated_robot import RATE
from edgefilter import Profile, calibrate, enhance
from edgefilter.diagnosis.diagnose import add
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.running import reach

TITLE = "What `add` brings to the running filter"
INTRODUCTION = """`edgefilter add EFFECT` fits an effect to some seconds of the robot alone and writes it into the
profile. This is what `run` makes of it, effect by effect, on simulated robots that have it (by code of its own,
[bench/README.md](../bench/README.md)): calibrated before, then the effect, clear or moderate; `add` gets the robot
alone for 10 to 20 s; the filter starts anew after that, with the profile as calibrated and with the effect added.
ERLE is over 3.5 s of the robot alone, from one second on; SI-SDR over the human who interrupts then, 4.5 to 10.5 dB
over the fan. dB, mean, before -> after; change with its 95 % bootstrap interval. In a word: better or worse where
the interval of SI-SDR, or if that says nothing the one of ERLE, leaves out 0. The filter learns while it runs, so
what is shown is what it need not learn first.
"""
ENGINES = ("linear", "ss", "crnn")
SETTLE, EDGE = RATE, RATE // 5
"""Samples of the filter's start, in which the lag is found, and before the human, that ERLE leaves out."""


@dataclass(frozen=True)
class Row:
    """One conversation through one engine, dB each: with the profile as it was and with the effect."""

    effect: str
    strength: str
    engine: str
    si_sdr_before: float
    si_sdr_after: float
    erle_before: float
    erle_after: float


def score(scene: EffectConversation, profile: Profile, engine: str) -> tuple[float, float]:
    """SI-SDR over the human and ERLE over the robot alone, dB, of the filter started after the early part."""
    mic, ref = scene.mic[scene.early :], scene.ref[scene.early :]
    out = enhance(mic, ref, profile, engine)
    span = slice(scene.human.start - scene.early, scene.human.stop - scene.early)
    alone = slice(SETTLE, span.start - EDGE)
    return si_sdr(out[span], scene.clean[scene.human]), erle(mic[alone], out[alone])


def measure(scene: EffectConversation, engines: Sequence[str]) -> list[Row]:
    """All engines on one conversation."""
    plain = calibrate(*scene.calibration)
    knowing, _, _ = add(plain, scene.effect, scene.mic[: scene.early], scene.ref[: scene.early])
    rows = []
    for engine in engines:
        (si_sdr_before, erle_before), (si_sdr_after, erle_after) = (
            score(scene, profile, engine) for profile in (plain, knowing)
        )
        rows.append(Row(scene.effect, scene.strength, engine, si_sdr_before, si_sdr_after, erle_before, erle_after))
    return rows


def change(rows: Sequence[Row], what: str) -> tuple[float, float, float]:
    """Mean of after less before, and its interval."""
    found = [getattr(row, f"{what}_after") - getattr(row, f"{what}_before") for row in rows]
    return float(np.mean(found)), *interval(lambda x: x.mean(axis=1), found)


def verdict(rows: Sequence[Row]) -> str:
    """In a word, by the interval of SI-SDR, and by that of ERLE where the former says nothing."""
    for what in ("si_sdr", "erle"):
        _, low, high = change(rows, what)
        if low > 0.0 or high < 0.0:
            return "better" if low > 0.0 else "worse"
    return "the same"


def page(rows: Sequence[Row]) -> str:
    """The tables, and what the running filter makes of each effect in its own words."""
    lines = results_writer.table(
        ["effect", "engine", "conversations", "SI-SDR dB", "change", "ERLE dB", "change", "in a word"],
        [_cells(effect, engine, _of(rows, effect, engine)) for effect, engine in _pairs(rows)],
    )
    notes = [(effect.name, reach(effect, {p.name: p.high for p in effect.parameters})) for effect in EFFECTS]
    said = [[name, note] for name, note in notes if note]
    return "\n".join([*lines, "", "What `add` says of an effect that the running filter does not take as it is:", ""]
                     + results_writer.table(["effect", "NOTE"], said))  # fmt: skip


def _pairs(rows: Sequence[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((row.effect, row.engine) for row in sorted(rows, key=lambda row: _PLACE[row.effect])))


def _of(rows: Sequence[Row], effect: str, engine: str) -> list[Row]:
    return [row for row in rows if (row.effect, row.engine) == (effect, engine)]


def _cells(effect: str, engine: str, rows: Sequence[Row]) -> list[str]:
    cells = [effect, engine, str(len(rows))]
    for what in ("si_sdr", "erle"):
        before, after = (np.mean([getattr(row, f"{what}_{when}") for row in rows]) for when in ("before", "after"))
        mean, low, high = change(rows, what)
        cells += [f"{before:.1f} -> {after:.1f}", f"{mean:+.1f} [{low:+.1f}, {high:+.1f}]"]
    return [*cells, verdict(rows)]


_PLACE = {effect.name: place for place, effect in enumerate(EFFECTS)}


def conversations(
    seed: int, count: int, effects: Sequence[str], voices: Path, speech: Path
) -> Iterator[EffectConversation]:
    """Lazily, `count` of each effect."""
    clips: dict[str, list[Clip]] = {}
    for clip in read_clips(voices, (1.0, 15.0)):
        clips.setdefault(clip.speaker, []).append(clip)
    people = read_clips(speech, (3.0, 6.0))
    wanted = [(effect, turn) for turn in range(count) for effect in SIMULATED if effect in effects]
    shown = tqdm(wanted, unit="case", disable=not sys.stderr.isatty())
    return (make(seed, effect, turn, clips, people) for effect, turn in shown)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, required=True, metavar="DIR", help="the robot's voices")
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="the humans")
    parser.add_argument("--count", type=int, default=10, help="conversations of each effect (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=41)
    parser.add_argument("--effects", default=",".join(SIMULATED), help="which of them (default: all)")
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--output", type=Path, metavar="PATH", help="also write PATH.md and PATH.json")
    parser.add_argument("--page", type=Path, metavar="FILE", help="also write the page of the documentation")
    options = parser.parse_args()
    effects, engines = options.effects.split(","), options.engines.split(",")
    for name in effects:
        find(name)
    made_with = results_writer.stamp({"ROBOT": [options.voices], "HUMAN": [options.speech]}, engines)
    rows = []
    for scene in conversations(options.seed, options.count, effects, options.voices, options.speech):
        rows += measure(scene, engines)
    content = {"seed": options.seed, "rows": [asdict(row) for row in rows]}
    print(results_writer.write(options.output, made_with, TITLE, page(rows), content))
    if options.page:
        text = "\n".join([f"# {TITLE}", "", INTRODUCTION, page(rows), "", f"Made by `{made_with['command']}`.", ""])
        options.page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
