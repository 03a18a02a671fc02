"""Simulate recordings of a robot with a hidden effect, or none, two, or one outside the catalogue.

    python -m bench.simulate.hidden_cases --voices robot/val robot/train --output DIR --seed 1 --set singles --count 78

--voices (and --speech, human talkers for the set `outside`): folders with a transcripts.tsv (path, speaker, seconds,
text). A case is a folder SET_NUMBER: sweep_ref, sweep_mic, fan_only (recorded before the effect), ref, mic, all FLAC,
16 kHz, 16 bit, and truth.json: effects (sorted; ["none"] or ["unknown"]), raw (what it is), strength, params,
effect_to_noise_db (power of what the effect changes at the microphone over the fan), robot_over_fan_db, tolerances,
voice, seed. Item i of a seed and set is the same whatever --count is.

Sets: `singles`, effect i mod 13 of CATALOGUE, strength clear, moderate, near in turn (39 cases are one of each);
`controls`, nothing hidden; `pairs`, two effects that can be told apart (all but APART), clear or moderate; `outside`,
kind i mod 7 of OUTSIDE, clear and moderate in turn. Every case, controls included, has the ordinary tolerances of a
real robot (hidden_robot.draw_scene).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal
from tqdm import tqdm

from bench.simulate.conversations import Clip, Voices, read_clips, read_speech, read_voices, write_item
from bench.simulate.hidden_effects import CATALOGUE, ENR_DB, NAMED, OUTSIDE, RANGES, in_room
from bench.simulate.hidden_robot import Chain, Scene, decibels, draw_scene, power
from bench.simulate.simulated_robot import RATE, Array, Rng

SETS = ("singles", "controls", "pairs", "outside")
ALONG_THE_CHAIN = (
    *("playback_gain", "bandlimit", "compression", "delay_jump", "speaker_nonlinearity", "rattle", "chassis_resonance"),
    *("late_reverb", "path_change", "clock_drift", "fan_noise", "mic_agc", "mic_clipping"),
)
"""The order in which two effects are applied."""
APART = {
    frozenset(pair.split())
    for pair in (
        "playback_gain compression, playback_gain mic_agc, compression mic_agc, compression speaker_nonlinearity, "
        "mic_clipping speaker_nonlinearity, mic_clipping compression, mic_clipping mic_agc, "
        "rattle speaker_nonlinearity, rattle mic_clipping, late_reverb path_change, clock_drift delay_jump, "
        "fan_noise mic_agc"
    ).split(", ")
}
"""Pairs that are not made: each could pass for the other or hides it."""
ROBOT_OVER_FAN_DB = {"clear": (23.0, 31.0), "moderate": (20.0, 30.0), "near": (18.0, 30.0), "control": (18.0, 30.0),
                     "pair": (21.0, 31.0)}  # fmt: skip
TRIES = 6
SECONDS = (20.0, 30.0)
EFFECTS = (*CATALOGUE, *NAMED)
STRENGTHS = ("clear", "moderate")
HUMAN_OVER_FAN_DB = (4.5, 10.5)
"""As in conversations: the robot is some 20 dB above the human."""
LATE_S, ALONE_S, HUMAN_S = 9.5, 4.5, (2.5, 6.0)
"""The filter starts in the pause nearest to LATE_S before the end, and has the robot alone for ALONE_S."""
PAUSE = RATE // 20


def read_reference(rng: Rng, clips: list[Clip]) -> Array:
    """Sentences of one voice for 20 to 30 s, (n,), peak 0.8, with pauses of 0.1-2 s, silence at both ends."""
    wanted = int(rng.uniform(*SECONDS) * RATE)
    parts, size = [np.zeros(int(rng.uniform(0.4, 1.0) * RATE))], 0
    for i in rng.permutation(len(clips)):
        pause = rng.uniform(0.1, 0.5) if rng.random() < 0.6 else rng.uniform(0.8, 2.0)
        parts += [read_speech(clips[i]), np.zeros(int(pause * RATE))]
        size = sum(part.size for part in parts)
        if size > wanted:
            break
    x = np.concatenate(parts)[: wanted - RATE // 2]
    x[-320:] *= np.linspace(1, 0, 320)
    return np.concatenate([0.8 * x / np.abs(x).max(), np.zeros(RATE // 2)])


def hide(rng: Rng, scene: Scene, chain: Chain, effect: str, strength: str) -> tuple[Chain, dict, float]:
    """The chain with this effect (drawn again while out of reach), its parameters, what it changes over the fan, dB."""
    physical = effect in RANGES
    best: tuple[float, Chain, dict, float] | None = None
    for _ in range(TRIES):
        changed, parameters = CATALOGUE[effect](rng, scene, chain, strength)
        found = change_db(scene, chain, changed, parameters if effect == "fan_noise" else None)
        miss = max(ENR_DB["near"] - found, 0.0) if physical else abs(found - ENR_DB[strength])
        if best is None or miss < best[0]:
            best = (miss, changed, parameters, found)
        if miss < 1.0:
            break
    return best[1:]


def change_db(scene: Scene, before: Chain, after: Chain, fan: dict | None) -> float:
    """Power of the changed part over the fan; of a fan that changed, the power that its spectrum gained or lost."""
    if fan:
        return fan["spectral_change_db"]
    return scene.over_fan_db(scene.record(after) - scene.record(before))


def make_case(
    seed: int, index: int, kind: str, voices: Voices, speech: list[Clip] = ()
) -> tuple[dict[str, Array], dict]:
    """Signals by name (n,) float64 and the contents of truth.json, for item index of this seed and set."""
    rng = np.random.default_rng([seed, SETS.index(kind), index])
    effects, strength = draw_effects(rng, index, kind)
    voice = str(rng.choice(sorted(voices)))
    scene = draw_scene(rng, read_reference(rng, voices[voice]), rng.uniform(*ROBOT_OVER_FAN_DB[strength]))
    chain, parameters, found = scene.usual, {}, {}

    def person(rng: Rng) -> Array:
        return read_speech(speech[rng.integers(len(speech))])

    for effect in effects:
        if kind == "outside":
            changed, parameters[effect] = OUTSIDE[effect](rng, scene, chain, strength, person)
            found[effect] = parameters[effect].get("incoherent_over_fan_db", change_db(scene, chain, changed, None))
            chain = changed
            continue
        force = strength if kind == "singles" else str(rng.choice(["clear", "moderate"]))
        chain, parameters[effect], found[effect] = hide(rng, scene, chain, effect, force)
    signals = scale(scene.signals | {"mic": scene.record(chain)}, parameters)
    named = ["unknown"] if kind == "outside" and effects[0] not in NAMED else sorted(effects) or ["none"]
    truth = {"effects": named, "raw": effects or ["none"], "strength": strength}
    if parameters.get("codec", {}).get("cuts_band"):
        truth["also"] = ["bandlimit"]
    truth |= {"params": parameters, "effect_to_noise_db": found}
    truth |= {"robot_over_fan_db": decibels(power(scene.echo(scene.usual)) / scene.fan_power)}
    return signals, truth | {"tolerances": scene.tolerances, "voice": voice, "seed": [seed, index]}


def draw_effects(rng: Rng, index: int, kind: str) -> tuple[list[str], str]:
    """What case index of a set hides, in the order of the chain, and how strongly."""
    if kind == "controls":
        return [], "control"
    if kind == "outside":
        return [list(OUTSIDE)[index % len(OUTSIDE)]], ("clear", "moderate")[index // len(OUTSIDE) % 2]
    if kind == "singles":
        return [list(CATALOGUE)[index % len(CATALOGUE)]], list(ENR_DB)[index // len(CATALOGUE) % 3]
    first = list(CATALOGUE)[index % len(CATALOGUE)]
    second = str(rng.choice([name for name in CATALOGUE if name != first and frozenset((first, name)) not in APART]))
    return sorted((first, second), key=ALONG_THE_CHAIN.index), "pair"


def scale(signals: dict[str, Array], parameters: dict) -> dict[str, Array]:
    """The recordings with one gain for all, so that none is beyond full scale."""
    recorded = ("sweep_mic", "fan_only", "mic")
    gain = min(1.0, 0.97 / max(np.abs(signals[name]).max() for name in recorded))
    if clipping := parameters.get("mic_clipping"):
        clipping["level"] *= gain
    return {name: gain * x if name in recorded else x for name, x in signals.items()}


@dataclass(frozen=True, eq=False)
class EffectConversation:
    """Signals (n,) float32, calibrated before the effect. early: samples of the robot alone, to fit to. human: where."""

    effect: str
    strength: str
    calibration: tuple[Array, Array, Array]
    ref: Array
    mic: Array
    clean: Array
    early: int
    human: slice


def make_conversation(seed: int, effect: str, turn: int, voices: Voices, speech: list[Clip]) -> EffectConversation:
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, required=True, nargs="+", metavar="DIR", help="the robot's voices")
    parser.add_argument("--speech", type=Path, metavar="DIR", help="human speech, for the set `outside`")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--set", choices=(*SETS, "all"), required=True)
    parser.add_argument("--count", type=int, default=39, help="cases of each set (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    voices = read_voices(options.voices)
    kinds = SETS if options.set == "all" else (options.set,)
    if "outside" in kinds and not options.speech:
        parser.error("the set `outside` needs --speech, a folder of human speech")
    speech = read_clips(options.speech, (2.0, 12.0)) if "outside" in kinds else []
    for kind in kinds:
        for index in tqdm(range(options.count), unit="case", desc=kind):
            signals, truth = make_case(options.seed, index, kind, voices, speech)
            write_item(options.output / f"{kind}_{index:03d}", signals, "truth", truth)


if __name__ == "__main__":
    main()
