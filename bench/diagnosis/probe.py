"""Probe: of two explanations of a short recording, one of them true, which one 5 s of sound tell.

The robots (bench/simulate/asked_robot.py) have changed since their calibration; both effects of a pair are fitted to a
few seconds of speech. Then the robot is asked: by sounds of the probe's own choice until the odds are 20 to 1, by a sweep
of 5 s, by 5 s of further sentences. All are recorded by the same robot and give odds in the same way. The last row asks the
probe as its command does: what the odds say must also hold, as a diagnosis judges it.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from bench import provenance, results
from bench.metrics import counted
from bench.provenance import DIAGNOSIS
from bench.recordings import progress
from bench.simulate.asked_robot import AskedRobot, make
from bench.simulate.conversations import read_voices
from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.sweep import generate_sweep
from edgefilter.diagnosis.probe import ENOUGH, SOUND_S, weights
from edgefilter.diagnosis.recording import Recording
from edgefilter.errors import SignalError
from edgefilter.types import Array

PAIRS = (
    ("playback_gain", "compression"),
    ("fan_noise", "codec"),
    ("chassis_resonance", "late_reverb"),
    ("equaliser", "early_path"),
    ("playback_gain", "equaliser"),
    ("compression", "speaker_nonlinearity"),
    ("mic_clipping", "speaker_nonlinearity"),
    ("chassis_resonance", "equaliser"),
)
STRENGTHS = ("near", "moderate")
RECORDING_S = ASKED_S = 5.0
"""Of speech to begin with, so short that explanations remain; and of sound that may be asked for."""
WAYS = ("the recording alone", "a sweep", "further sentences", "probe, by its odds", "probe")
TITLE = "What `probe` settles"


@dataclass(frozen=True)
class Row:
    """One robot: the pair, which of it is true, how strong, what came of it by each of WAYS, and what was asked."""

    pair: tuple[str, str]
    truth: str
    strength: str
    outcomes: tuple[str, ...]
    sounds: tuple[str, ...] = ()

    @property
    def ambiguous(self) -> bool:
        """Whether the recording alone does not settle what is true."""
        return self.outcomes[0] != "right"


def outcome(likely: Array, true: int, holds: bool = True) -> str:
    """Of the probabilities of a pair, and of none of it: right or wrong where ENOUGH to 1 speaks for one that holds, else open."""
    best = int(np.argmax(likely[:2]))
    if likely[best] < ENOUGH / (1.0 + ENOUGH) or not holds:
        return "open"
    return "right" if best == true else "wrong"


def examine(robot: AskedRobot, pair: tuple[str, str], strength: str) -> Row:
    """The row of one robot; open is also what cannot be asked, or was not heard."""
    inquiry = Recording(robot.recording, robot.reference, calibrate(*robot.calibration)).probe(
        [(name,) for name in pair]
    )
    true, peak = pair.index(robot.truth), float(np.abs(robot.reference).max())
    if len(inquiry.explanations) < len(pair):
        return Row(pair, robot.truth, strength, ("open",) * len(WAYS))
    sweep = generate_sweep(seconds=ASKED_S - 0.5, lead_s=0.25, tail_s=0.25, amplitude=peak)
    found = [outcome(inquiry.before(), true)]
    sounds: tuple[str, ...] = ()
    for sound in (sweep, robot.further):
        try:
            heard = inquiry.hear(robot.ask(sound, 1), sound)
            found.append(outcome(weights(heard.evidence, [inquiry.gains(sound)]), true))
        except SignalError:
            found.append("open")
    try:
        answer = inquiry.ask(lambda sound: robot.ask(sound.samples, 2), ASKED_S)
        found += [outcome(answer.likely, true, holds) for holds in (True, answer.holds)]
        sounds = answer.sounds
    except SignalError:
        found += ["open", "open"]
    return Row(pair, robot.truth, strength, tuple(found), sounds)


def share(rows: Sequence[Row], way: int) -> list:
    """How many are right, with its interval, how many open, how many wrong."""
    found = [row.outcomes[way] for row in rows]
    right = counted(one == "right" for one in found)
    said = f"{right['hits']} of {right['n']} [{right['low']:.0f}, {right['high']:.0f}] %"
    return [said, found.count("open"), found.count("wrong")]


def tables(rows: Sequence[Row]) -> list[dict]:
    """All robots and those that the recording leaves open or settles wrongly, by way; then each pair; then each sound."""
    hard = [row for row in rows if row.ambiguous]
    lines = [[way, *share(rows, at), *(share(hard, at) if hard and at else [None] * 3)] for at, way in enumerate(WAYS)]
    columns = ["", "settled rightly", "open", "wrongly", "where the recording does not settle it", "open", "wrongly"]
    seconds = np.mean([len(row.sounds) * SOUND_S for row in rows])
    said = f"Rightly and wrongly: at odds of {ENOUGH:.0f} to 1 or more. The probe took {seconds:.1f} s of sound in the mean."
    made = [results.table("probe", "Which of two explanations it is", columns, lines, said)]
    cells = []
    for pair in PAIRS:
        of = [row for row in rows if row.pair == pair]
        cells += [[" or ".join(pair), *(share(of, at)[0] for at in range(len(WAYS)))]] if of else []
    made.append(results.table("probe-pairs", "Settled rightly, by pair", ["", *WAYS], cells))
    asked = Counter(sound for row in rows for sound in row.sounds).most_common()
    made.append(results.table("probe-sounds", "What was asked", ["sound", "times"], map(list, asked)))
    return made


def run(options: argparse.Namespace) -> str:
    made_with = provenance.stamp({"ROBOT": [options.voices]}, [DIAGNOSIS])
    voices, rows = read_voices([options.voices]), []
    asked = [(number, pair, truth) for number in range(options.count) for pair in PAIRS for truth in pair]
    for number, pair, truth in progress(asked, "robot"):
        strength = STRENGTHS[number % len(STRENGTHS)]
        seed = [options.seed, PAIRS.index(pair), pair.index(truth), number]
        rows.append(examine(make(seed, truth, strength, voices, RECORDING_S), pair, strength))
    notes, kept = str(__doc__).partition("\n\n")[2].strip(), list(map(asdict, rows))
    return results.write(options.output, "probe", TITLE, made_with, tables(rows), notes=notes, rows=kept)
