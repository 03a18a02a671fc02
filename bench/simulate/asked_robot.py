"""A simulated robot that has changed since its calibration and can be asked: it plays any sound and its microphone records that.

The robots, rooms and tolerances are those of hidden_robot, most changes those of hidden_effects, at the strengths of
hidden_cases; a player's equaliser, another place of the microphone and a codec of libsndfile are added here.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import soundfile as sf
from scipy import signal

from bench.simulate import hidden_effects as effects
from bench.simulate.conversations import Clip, Voices, read_speech
from bench.simulate.hidden_cases import ROBOT_OVER_FAN_DB, hide
from bench.simulate.hidden_robot import Chain, Scene, direction, draw_scene, power, solve
from bench.simulate.simulated_robot import RATE, Array, Rng, fan_noise, peak_filter

Player = Callable[[Array], Array]
Change = Callable[[Rng, Scene, str], tuple[Chain, Player]]
AFTER_S = 1.0
"""For so long the recording goes on after a sound, as `play_and_record` does."""
CODECS = (("OGG", "OPUS"), ("MP3", "MPEG_LAYER_III"))
SHARES = np.linspace(0.99, 0.0, 12)
"""Of the bits that libsndfile may save: from the lowest rate on."""
HEADROOM = 0.97


@dataclass(frozen=True, eq=False)
class AskedRobot:
    """Calibration (sweep, its recording, the fan), reference and recording, float32; truth: the hidden effect."""

    truth: str
    calibration: tuple[Array, Array, Array]
    reference: Array
    recording: Array
    further: Array
    _scene: Scene
    _chain: Chain
    _player: Player
    _gain: float

    def ask(self, sound: Array, seed: int) -> Array:
        """What the microphone records of a sound (n,) and for a second after it, (n + RATE,)."""
        x = np.pad(sound.astype(np.float64), (0, round(AFTER_S * RATE)))
        fan = self._fan(seed, x.size)
        return np.float32(self._gain * self._scene.record(replace(self._chain, played=self._player(x), fan=fan)))

    def _fan(self, seed: int, n: int) -> Array:
        """Other noise of the same spectrum as the end of the recording has, (n,)."""
        end = self._chain.fan[self._chain.fan.size // 2 :]
        hz, psd = signal.welch(end, fs=RATE, nperseg=2048)
        noise = fan_noise(np.random.default_rng(seed), np.sqrt(psd), n)
        return noise * math.sqrt(power(end) / power(noise))


def make(seed: list[int], truth: str, strength: str, voices: Voices, seconds: float) -> AskedRobot:
    """A robot with that effect (a name of CHANGES), a recording of so many seconds of its sentences, and as many further ones."""
    rng = np.random.default_rng(seed)
    clips = voices[str(rng.choice(sorted(voices)))]
    x, further = (_sentences(rng, clips, seconds) for _ in range(2))
    scene = draw_scene(rng, np.pad(x, (RATE // 2, RATE // 2)), rng.uniform(*ROBOT_OVER_FAN_DB[strength]))
    chain, player = CHANGES[truth](rng, scene, strength)
    recorded = (scene.signals["sweep_mic"], scene.signals["fan_only"], scene.record(chain))
    gain = min(1.0, HEADROOM / max(float(np.abs(one).max()) for one in recorded))
    swept, fan, heard = (np.float32(gain * one) for one in recorded)
    calibration = np.float32(scene.signals["sweep_ref"]), swept, fan
    reference = np.float32(scene.reference)
    return AskedRobot(truth, calibration, reference, heard, np.float32(further), scene, chain, player, gain)


def _sentences(rng: Rng, clips: list[Clip], seconds: float) -> Array:
    """So many seconds of sentences in random order, (n,), 0.1 to 0.5 s apart, peak 0.8, faded out."""
    parts: list[Array] = []
    for i in rng.permutation(len(clips)):
        parts += [read_speech(clips[i]), np.zeros(round(rng.uniform(0.1, 0.5) * RATE))]
        if sum(part.size for part in parts) > seconds * RATE:
            break
    x = np.concatenate(parts)[: round(seconds * RATE)]
    x[-320:] *= np.linspace(1, 0, 320)
    return 0.8 * x / np.abs(x).max()


def _same(x: Array) -> Array:
    return x


def _hidden(name: str) -> Change:
    """What draws one of `hidden_effects` for a robot, and a player with the same effect for the test sounds that the diagnosis asks for."""

    def change(rng: Rng, scene: Scene, strength: str) -> tuple[Chain, Player]:
        chain, parameters, _ = hide(rng, scene, scene.usual, name, strength)
        return chain, PLAYERS.get(name, lambda told, x: _same)(parameters, scene.reference)

    return change


def _volume(told: dict, reference: Array) -> Player:
    return lambda x: 10 ** (told["gain_db"] / 20) * x


def _compressor(told: dict, reference: Array) -> Player:
    settings = {key: told[key] for key in ("threshold_db", "ratio", "knee_db", "attack_ms", "release_ms")}

    def squeezed(x: Array) -> Array:
        return x * effects.gain_curve(effects.compressor_gain_db(x, **settings), 1, x.size)

    makeup = math.sqrt(power(reference) / power(squeezed(reference))) if told["makeup"] else 1.0
    return lambda x: makeup * squeezed(x)


def _amplifier(told: dict, reference: Array) -> Player:
    if told["kind"] == "driver":
        return _same  # the chain's loudspeaker has it
    level, skew, hardness = (told[key] for key in ("level", "skew", "hardness"))
    return lambda x: effects.soft_clip(x, level, skew * level, hardness)


PLAYERS = {"playback_gain": _volume, "compression": _compressor, "speaker_nonlinearity": _amplifier}


def equaliser(rng: Rng, scene: Scene, strength: str) -> tuple[Chain, Player]:
    """Two or three broad peaks or dips in the player (Bristow-Johnson), as strong together as wanted."""
    bands = [(effects.log_uniform(rng, 300, 5000), rng.uniform(0.6, 1.5), effects.sign(rng))
             for _ in range(int(rng.integers(2, 4)))]  # fmt: skip

    def player(db: float) -> Player:
        sections = np.vstack([peak_filter(hz, q, sign * db) for hz, q, sign in bands])
        return lambda x: signal.sosfilt(sections, x)

    usual = scene.echo(scene.usual)

    def chain(db: float) -> Chain:
        return replace(scene.usual, played=player(db)(scene.reference))

    db = solve(lambda db: scene.over_fan_db(scene.echo(chain(db)) - usual), effects.ENR_DB[strength], 0.2, 15.0, 0.5)
    return chain(db), player(db)


def moved(rng: Rng, scene: Scene, strength: str) -> tuple[Chain, Player]:
    """The microphone stands some millimetres or centimetres elsewhere from the start."""
    step, usual = direction(rng), scene.echo(scene.usual)

    def chain(metres: float) -> Chain:
        return replace(scene.usual, paths=((0, 0, scene.moved.microphone_moved(metres * step).response()),))

    metres = solve(lambda m: scene.over_fan_db(scene.echo(chain(m)) - usual), effects.ENR_DB[strength], 1e-3, 0.05, 0.5)
    return chain(metres), _same


def codec(rng: Rng, scene: Scene, strength: str) -> tuple[Chain, Player]:
    """The player's sound through Opus or MP3, at the lowest rate whose noise does not exceed the strength."""
    form, subtype = CODECS[int(rng.integers(len(CODECS)))]
    response = scene.linear_response()

    def coder(share: float) -> Player:
        def through(x: Array) -> Array:
            packed = io.BytesIO()
            sf.write(packed, x.astype(np.float32), RATE, format=form, subtype=subtype, compression_level=share)
            packed.seek(0)
            return effects.put_back(sf.read(packed, dtype="float64")[0], x)

        return through

    for share in SHARES:
        player = coder(float(share))
        played = player(scene.reference)
        heard, original = (signal.oaconvolve(x, response)[: x.size] for x in (played, scene.reference))
        if effects.incoherent_db(original, heard) + scene.over_fan_db(heard) < effects.ENR_DB[strength]:
            break
    return replace(scene.usual, played=played), player


HIDDEN = ("playback_gain", "compression", "speaker_nonlinearity", "mic_clipping", "chassis_resonance", "late_reverb",
          "fan_noise")  # fmt: skip
CHANGES: dict[str, Change] = {name: _hidden(name) for name in HIDDEN}
CHANGES |= {"equaliser": equaliser, "early_path": moved, "codec": codec}
