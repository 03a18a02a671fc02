"""What each effect must show before it is named: its complexity, its least size, and what its parameters must look like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edgefilter.diagnosis.score import Judge, Verdict
from edgefilter.echo.effect import Values, find, whiten
from edgefilter.echo.effects.bandlimit import measured_response_db
from edgefilter.echo.effects.gain_law import STEP, by_step
from edgefilter.types import SAMPLE_RATE

FAN_ALONE = 1.6
"""Times the fan's power up to which a step of 25 ms may show nothing else."""
MISSING_DB = -0.3
"""Under the fan: where the residual is so little of what a model expects, some of what it expects is not there."""
Guard = Callable[[Values, Judge, Verdict, Verdict], bool]


@dataclass(frozen=True)
class Suspect:
    """complexity: of two effects that explain about as much, the lower one is named. least_gain_db: fall of the held-out level.

    least_size_db: power of what the effect changes, over the fan. guard: False where the parameters say that it is something else.
    """

    complexity: int
    least_gain_db: float = 0.05
    least_size_db: float = -6.0
    guard: Guard | None = None


def _audible_gain(values: Values, *_: object) -> bool:
    return abs(float(values["gain_db"])) >= 0.2


def _dull_above(cutoff_hz: float, judge: Judge, before: Verdict) -> bool:
    """Whether the recording's power above the cut-off falls with what it has in common with the reference: a codec's noise keeps it up."""
    above = judge.band_hz[:, 0] > 1.1 * cutoff_hz
    heard = judge.cells(judge.prepared.measurement.recording)[judge.active_cells][:, above]
    expected = judge.cells(before.prediction)[judge.active_cells][:, above]
    loud = expected > 3.0
    if loud.sum() < 10:
        return True
    return float(np.sum(np.maximum(heard[loud] - 1.0, 0.0))) < 0.5 * float(np.sum(expected[loud]))


def _cuts_the_band(values: Values, judge: Judge, before: Verdict, after: Verdict) -> bool:
    """A low-pass and not a colouring: flat below the cut-off, little above it; near 8 kHz, where that cannot be seen, the low-pass alone helps."""
    if float(values["cutoff_hz"]) >= 7700.0:
        return False
    if not _dull_above(float(values["cutoff_hz"]), judge, before):
        return False
    hz, gain_db = measured_response_db(values)
    passed = gain_db[(hz > min(300.0, 0.3 * float(values["cutoff_hz"]))) & (hz < 0.7 * float(values["cutoff_hz"]))]
    stopped = gain_db[hz > 1.2 * float(values["cutoff_hz"])]
    if stopped.size and passed.size:
        return float(np.std(passed)) < 2.0 and float(np.median(stopped)) < float(np.median(passed)) - 6.0
    plain = find("bandlimit").apply(before.prediction, {**values, "taps": 0.0}, SAMPLE_RATE)
    return before.level_db - judge.judge(plain).level_db > 0.5 * (before.level_db - after.level_db)


def _drifts(values: Values, *_: object) -> bool:
    return abs(float(values["ppm"])) >= 0.5


def _rings(values: Values, *_: object) -> bool:
    q, hz = np.atleast_1d(values["q"]), np.atleast_1d(values["frequency_hz"])
    return bool(np.all(q > 4.2) and np.all(hz >= 62.0) and np.all(hz <= 6800.0))


def _clean_before(values: Values, judge: Judge, before: Verdict, after: Verdict) -> bool:
    """Whether the path was the calibrated one until it changed: most of what the effect explains lies after its time, little before."""
    time = float(values["time_s"])
    early = judge.active_cells & (judge.starts < time * SAMPLE_RATE)
    late = judge.active_cells & (judge.starts >= time * SAMPLE_RATE)
    if early.sum() < 6 or late.sum() < 6:
        return False
    level = 10 * np.log10(np.maximum(before.cells, 1e-3)) @ judge.freedom / judge.freedom.sum()
    explained = 10 * np.log10(np.maximum(after.cells, 1e-3)) @ judge.freedom / judge.freedom.sum()
    rest = float(np.mean(level[early]) - np.mean(explained[late]))
    return rest < 0.5 * float(np.mean(level[late]) - np.mean(explained[late]))


def _jumps(values: Values, *_: object) -> bool:
    return bool(np.any(np.abs(np.atleast_1d(np.asarray(values["samples"], float))) >= 0.3))


def _follows_the_level(values: Values, *_: object) -> bool:
    return float(values["ratio"]) >= 1.1


def _moves_slowly(values: Values, *_: object) -> bool:
    return float(values["range_db"]) >= 0.4


def _fan_follows(values: Values, judge: Judge, before: Verdict, after: Verdict) -> bool:
    """Whether the fan moves with the gain, as it does behind a microphone's control and does not behind a player's.

    By the likelihood of the residual's power in steps where little but the fan is left, its level constant or times the gain's square.
    """
    if not _moves_slowly(values):
        return False
    measurement = judge.prepared.measurement
    gain = find("mic_agc").apply(np.ones_like(measurement.recording), values, SAMPLE_RATE)
    white = whiten(measurement.recording - after.prediction, measurement.noise_psd).astype(np.float64) ** 2
    square, power = (by_step(x) / STEP for x in (gain.astype(np.float64) ** 2, white))
    low = (power < FAN_ALONE * square) & (by_step(judge.prepared.usable.astype(float)) == STEP)
    if low.sum() < 20:
        return False
    moving, still = np.log(np.mean(power[low] / square[low])) + np.mean(np.log(square[low])), np.log(np.mean(power[low]))
    return bool(moving < still)


def _knocks_where_fitted(values: Values, judge: Judge, before: Verdict, after: Verdict) -> bool:
    """Whether the knocks' noise is there on the samples fitted to as well: what a long filter errs by is on the held-out ones alone."""
    return after.fitted_db >= MISSING_DB + min(after.silent_db, 0.0)


def _reverberates(values: Values, *_: object) -> bool:
    return float(values["level_db"]) > -100.0


SUSPECTS: dict[str, Suspect] = {
    "playback_gain": Suspect(0, guard=_audible_gain),
    "clock_drift": Suspect(1, guard=_drifts),
    "chassis_resonance": Suspect(1, guard=_rings),
    "bandlimit": Suspect(1, guard=_cuts_the_band),
    "mic_clipping": Suspect(1, least_size_db=-9.0),
    "delay_jump": Suspect(1, guard=_jumps),
    "compression": Suspect(2, guard=_follows_the_level),
    "mic_agc": Suspect(1, guard=_fan_follows),
    "speaker_nonlinearity": Suspect(3),
    "rattle": Suspect(3, guard=_knocks_where_fitted),
    "path_change": Suspect(4, guard=_clean_before),
    "late_reverb": Suspect(4, guard=_reverberates),
}
"""Every effect whose presence shows while the robot is heard; the fan is looked at in the silences."""
OWN = Suspect(3)
"""An effect of the user's own."""


def suspect(name: str) -> Suspect:
    """What the effect of that name must show."""
    return SUSPECTS.get(name, OWN)


NESTED = 0.85
"""A simpler effect that explains this share of what the best one does is preferred to it."""


def choose(gains: dict[str, float]) -> str | None:
    """The effect to name, from the falls in level that the admissible ones bring; None where there is none."""
    most = max(gains.values(), default=0.0)
    if not most > 0.0:
        return None
    enough = [name for name, gain in gains.items() if gain >= NESTED * most]
    return min(enough, key=lambda name: (suspect(name).complexity, -gains[name]))
