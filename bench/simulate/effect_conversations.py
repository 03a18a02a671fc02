"""A robot that has one effect that the diagnosis names, alone at first, and a human who interrupts it late in the recording.

The robots, their calibration and the effects are those of hidden_cases, simulated by code of its own; the human is at
the microphone before anything that the microphone does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from bench.simulate.conversations import Clip, read_speech
from bench.simulate.hidden_cases import ROBOT_OVER_FAN_DB, hide, read_reference
from bench.simulate.hidden_effects import CATALOGUE, NAMED, OUTSIDE, in_room
from bench.simulate.hidden_robot import draw_scene, power
from bench.simulate.simulated_robot import RATE, Array

EFFECTS = (*CATALOGUE, *NAMED)
STRENGTHS = ("clear", "moderate")
HUMAN_OVER_FAN_DB = (4.5, 10.5)
"""As in conversations: the robot is some 20 dB above the human."""
LATE_S, ALONE_S, HUMAN_S = 9.5, 4.5, (2.5, 6.0)
"""The filter starts in the pause nearest to LATE_S before the end, and has the robot alone for ALONE_S."""
PAUSE = RATE // 20


@dataclass(frozen=True, eq=False)
class EffectConversation:
    """Signals (n,) float32 at 16 kHz; sweep_ref, sweep_mic, fan_only from before the effect.

    early: samples of the robot alone, to fit an effect to; from there on the filter runs. human: its samples.
    """

    effect: str
    strength: str
    calibration: tuple[Array, Array, Array]
    ref: Array
    mic: Array
    clean: Array
    early: int
    human: slice


def make(seed: int, effect: str, turn: int, voices: dict[str, list[Clip]], speech: list[Clip]) -> EffectConversation:
    """The effect's conversation number `turn` of a seed, clear and moderate in turns; effect: one of EFFECTS."""
    place, strength = EFFECTS.index(effect), STRENGTHS[turn % len(STRENGTHS)]
    beyond = [place] if place >= len(CATALOGUE) else []
    rng = np.random.default_rng([seed, turn if beyond else turn * len(CATALOGUE) + place, *beyond])
    voice = str(rng.choice(sorted(voices)))
    scene = draw_scene(rng, read_reference(rng, voices[voice]), rng.uniform(*ROBOT_OVER_FAN_DB[strength]))
    if effect in CATALOGUE:
        chain, _, _ = hide(rng, scene, scene.usual, effect, strength)
    else:
        chain, _ = OUTSIDE[effect](rng, scene, scene.usual, strength, lambda rng: np.zeros(0))
    ref = scene.reference
    early = find_pause(ref, ref.size - int(LATE_S * RATE))
    start = early + int(ALONE_S * RATE)
    words = read_speech(speech[rng.integers(len(speech))])[: int(HUMAN_S[1] * RATE)]
    human = np.zeros(ref.size)
    human[start : start + words.size] = words[: ref.size - start]
    human = in_room(rng, human)
    span = slice(start, min(start + words.size, ref.size))
    human *= np.sqrt(scene.fan_power / power(human[span])) * 10 ** (rng.uniform(*HUMAN_OVER_FAN_DB) / 20)
    mic = scene.record(replace(chain, others=human))
    recorded = [scene.signals["sweep_mic"], scene.signals["fan_only"], mic]
    gain = min(1.0, 0.97 / max(float(np.abs(x).max()) for x in recorded))
    sweep_mic, fan_only, mic, human = (np.float32(gain * x) for x in (*recorded, human))
    calibration = np.float32(scene.signals["sweep_ref"]), sweep_mic, fan_only
    return EffectConversation(effect, strength, calibration, np.float32(ref), mic, human, early, span)


def find_pause(x: Array, about: int) -> int:
    """The middle of the pause of x (n,) that is nearest to a sample."""
    loud = signal.lfilter(np.ones(PAUSE), [1.0], np.abs(x)) > 1e-3 * PAUSE * np.abs(x).max()
    quiet = np.flatnonzero(~loud[PAUSE:]) + PAUSE // 2
    return int(quiet[np.argmin(np.abs(quiet - about))])
