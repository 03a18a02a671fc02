"""Simulated robots whose sound passes through programs that nobody here wrote.

    python -m bench.simulate.wild --voices robot/val robot/train --output DIR --seed 1 --half tuning --count 40

A case is a folder HALF_NUMBER as bench.simulate.hidden_cases writes them; truth.json besides says what other names
are right (also; a volume, where at its setting the program does no more), which program it was and its setting. The
programs come in turn, every tenth case is a control; a setting is drawn again, at most six times, while it changes less
than LEAST_DB over the fan. Robot, room and tolerances are those of hidden_robot. The halves `reporting` and `unseen` are
for figures, never for tuning: no two halves share a suite. `combined` hides two or three effects at once, by programs of `tuning`
and a fan that has changed; each changes the recording by LEAST_DB or more, behind those before it.

Debian: sox ffmpeg swh-plugins tap-plugins cmt caps invada-studio-plugins-ladspa zam-plugins vlevel lame opus-tools speex
libgsm-tools fil-plugins rev-plugins guitarix-ladspa blop vorbis-tools dpf-plugins-ladspa. PyPI: pedalboard noisereduce webrtc-noise-gain.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile as sf
from scipy import signal
from tqdm import tqdm

from bench.simulate.conversations import Voices, read_voices, write_item
from bench.simulate.hidden_cases import read_reference, scale
from bench.simulate.hidden_effects import fan_noise, log_uniform, put_back
from bench.simulate.hidden_robot import Chain, Place, Scene, decibels, direction, draw_scene, power
from bench.simulate.simulated_robot import RATE, Array, Rng

EVERY = 10
ROBOT_OVER_FAN_DB = (20.0, 30.0)
LEAST_DB, CLEAR_DB = 2.0, 8.5
TRIES = 6
TAIL_S = 1.0
"""By which a program may lengthen the room's response."""
LADSPA = "/usr/lib/ladspa"
RAW = ("-f", "f32le", "-ac", "1", "-ar", str(RATE))


@dataclass(frozen=True)
class Command:
    """One setting of a program: the words that its manual knows it by, and what it makes of samples (n,) at 16 kHz."""

    words: str
    run: Callable[[Array], Array]

    def __call__(self, x: Array) -> Array:
        """Run x (n,) through the program and undo its delay in whole samples; exits where the output is not finite."""
        y = self.run(x)
        if wrong := int(np.count_nonzero(~np.isfinite(y))):
            sys.exit(
                f"{self.words}: {wrong} of {y.size} samples that came out are not finite, expected none; leave this program out"
            )
        return put_back(y, x)


@dataclass(frozen=True)
class Program:
    """One effect of one program: its place in the signal chain, the names that are right, and a setting drawn at random.

    right: the first is what the manual says that the effect does, others that are right as well stand behind it. draw:
    None for a simulator of rooms, which is given the room itself, and for the changed fan of hidden_effects.
    """

    name: str
    place: Literal["source", "room", "microphone", "fan"]
    right: tuple[str, ...]
    draw: Callable[[Rng], Command] | None


def sox(*effect: object) -> Command:
    words = [str(word) for word in effect]
    raw = ["-t", "f32", "-r", str(RATE), "-c", "1", "-"]
    return Command("sox " + " ".join(words), lambda x: _piped(["sox", "-V1", "-R", *raw, *raw, *words], x))


def ffmpeg(filters: str) -> Command:
    return Command(f"ffmpeg -af {filters}", lambda x: _filtered(x, filters))


def ladspa(file: str, label: str, *controls: float, channels: int = 1, rate: int = RATE) -> Command:
    """One channel through a LADSPA plugin of so many inputs, at that rate, its controls in their order (by ffmpeg)."""
    values = "|".join(f"c{i}={value:g}" for i, value in enumerate(controls))
    spread = "pan=stereo|c0=c0|c1=c0," if channels == 2 else ""
    filters = f"aresample={rate},{spread}ladspa=f={file}:p={label}:c={values},pan=mono|c0=c0"
    return Command(f"{file} {label} {values}", lambda x: _filtered(x, filters))


def ladspa_by_rate(file: str, label: str, *controls: float) -> Command:
    """The same for a plugin whose controls have bounds in parts of the sampling rate, which ffmpeg does not know: SoX hosts it."""
    return sox("ladspa", f"{LADSPA}/{file}.so", label, *(f"{value:g}" for value in controls))


def coded(encode: str, decode: str, rate: int = RATE) -> Command:
    """A codec's own two programs, as shell words with {wav} (16 bit), {packed} and {out} (a WAV file)."""

    def run(x: Array) -> Array:
        with tempfile.TemporaryDirectory() as folder:
            paths = {name: Path(folder, f"{name}.wav") for name in ("wav", "packed", "out")}
            sf.write(paths["wav"], signal.resample_poly(x, rate, RATE), rate, subtype="PCM_16")
            for line in (encode, decode):
                subprocess.run(line.format(**paths), shell=True, check=True, capture_output=True)
            y, decoded = sf.read(paths["out"], dtype="float64")
        return signal.resample_poly(y if y.ndim == 1 else y[:, 0], RATE, decoded)

    return Command(f"{encode} ; {decode}", run)


def pedalboard(name: str, **settings: float) -> Command:
    def run(x: Array) -> Array:
        plugin = getattr(importlib.import_module("pedalboard"), name)(**settings)
        return np.asarray(plugin(x.astype(np.float32), RATE), float)

    return Command(f"pedalboard.{name}({_listed(settings)})", run)


def noisereduce(**settings: float) -> Command:
    def run(x: Array) -> Array:
        return np.asarray(importlib.import_module("noisereduce").reduce_noise(y=x, sr=RATE, **settings), float)

    return Command(f"noisereduce.reduce_noise({_listed(settings)})", run)


def webrtc(auto_gain: int, noise_suppression: int) -> Command:
    """webrtc-noise-gain: target level -dBFS of its gain control, 0 to 4 for its noise suppression."""

    def run(x: Array) -> Array:
        device = importlib.import_module("webrtc_noise_gain").AudioProcessor(auto_gain, noise_suppression)
        pcm = np.round(32767 * np.clip(np.pad(x, (0, -x.size % 160)), -1, 1)).astype(np.int16).reshape(-1, 160)
        out = b"".join(device.Process10ms(frame.tobytes()).audio for frame in pcm)
        return np.frombuffer(out, np.int16)[: x.size] / 32768.0

    return Command(f"webrtc_noise_gain.AudioProcessor({auto_gain}, {noise_suppression})", run)


def _listed(settings: dict[str, float]) -> str:
    return ", ".join(f"{key}={value:.4g}" for key, value in settings.items())


def _filtered(x: Array, filters: str) -> Array:
    return _piped(["ffmpeg", "-v", "error", "-threads", "1", *RAW, "-i", "-", "-af", filters, *RAW, "-"], x)


def _piped(command: list[str], x: Array) -> Array:
    """What a program makes of 32-bit floats on its standard input, (m,); ends the program with its own words."""
    raw, environment = x.astype(np.float32).tobytes(), os.environ | {"LADSPA_PATH": LADSPA}
    try:
        done = subprocess.run(command, input=raw, capture_output=True, env=environment)
    except FileNotFoundError:
        sys.exit(f"{command[0]} was not found; bench/simulate/wild.py says which packages are needed")
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed: {done.stderr.decode(errors='replace').strip()[-300:]}")
    return np.frombuffer(done.stdout, np.float32).astype(np.float64)


def either(rng: Rng, low: float, high: float) -> float:
    """A number of that size, of either sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def volume(rng: Rng) -> float:
    """Draw a gain in dB: much softer, or a little louder, as the headroom is."""
    return float(rng.choice([rng.uniform(-8.0, -1.5), rng.uniform(1.5, 2.5)]))


def gains(rng: Rng, count: int, most: float = 9.0) -> list[float]:
    """Levels of neighbouring bands, none alike, (count,) in dB."""
    return [float(round(value, 1)) for value in rng.uniform(-most, most, count)]


def echoes_ms(rng: Rng, count: int) -> list[float]:
    return sorted(float(round(value, 2)) for value in rng.uniform(1.0, 9.0, count))


def _parametric(r: Rng) -> Command:
    bands = [(either(r, 3, 9), f * r.uniform(0.7, 1.4), r.uniform(0.8, 2.5)) for f in (350.0, 1200.0, 3500.0)]
    low, high = (either(r, 0, 5), r.uniform(150, 300), 0.5), (either(r, 2, 6), r.uniform(3500, 6000), 0.5)
    return ladspa_by_rate("triple_para_1204", "triplePara", *(value for band in (low, *bands, high) for value in band))


def _sox_echo(r: Rng) -> Command:
    pairs = [word for ms in echoes_ms(r, int(r.integers(1, 4))) for word in (ms, round(float(r.uniform(0.15, 0.4)), 2))]
    return sox("echo", 1.0, 1.0, *pairs)


def _sox_compand(r: Rng) -> Command:
    knee, ratio = r.uniform(-36, -24), r.uniform(2.5, 6)
    times = f"{r.uniform(0.003, 0.02):.3f},{r.uniform(0.1, 0.5):.2f}"
    return sox("compand", times, f"6:-90,-90,{knee:.1f},{knee:.1f},0,{knee * (1 - 1 / ratio):.1f}", "0", "-30")


def _sox_multiband(r: Rng) -> Command:
    def band() -> str:
        knee, ratio = r.uniform(-45, -30), r.uniform(2.0, 6.0)
        times = f"{r.uniform(0.003, 0.01):.3f},{r.uniform(0.08, 0.3):.2f}"
        return f"{times} 6:-90,-90,{knee:.1f},{knee:.1f},0,{knee * (1 - 1 / ratio):.1f} 0 -30"

    return sox("mcompand", band(), f"{r.uniform(300, 700):.0f}", band(), f"{r.uniform(1500, 3000):.0f}", band())


def _firequalizer(r: Rng) -> Command:
    bands = zip((60, 250, 600, 1400, 3000, 7500), [0.0, *gains(r, 5)], strict=True)
    return ffmpeg("firequalizer=gain_entry='" + ";".join(f"entry({hz},{db})" for hz, db in bands) + "'")


def _aecho(r: Rng) -> Command:
    delays = echoes_ms(r, int(r.integers(1, 4)))
    decays = [f"{r.uniform(0.15, 0.4):.2f}" for _ in delays]
    return ffmpeg(f"aecho=1:1:{'|'.join(map(str, delays))}:{'|'.join(decays)}")


def _limiter(r: Rng) -> Command:
    limit, attack, release = r.uniform(0.12, 0.35), r.uniform(2, 8), log_uniform(r, 30, 400)
    return ffmpeg(f"alimiter=limit={limit:.3f}:attack={attack:.1f}:release={release:.0f}:level=0")


def _acompressor(r: Rng) -> Command:
    level, ratio = r.uniform(-34, -22), r.uniform(2.5, 8)
    attack, release = log_uniform(r, 2, 30), log_uniform(r, 60, 500)
    return ffmpeg(f"acompressor=threshold={level:.0f}dB:ratio={ratio:.1f}:attack={attack:.1f}:release={release:.0f}")


def _mcompand(r: Rng) -> Command:
    curve, last = "6 -47/-40\\,-34/-34\\,-17/-33", "6 -47/-40\\,-34/-34\\,-15/-33 7900"
    highest = f"0.000625\\,{r.uniform(0.01, 0.05):.4f} {last}"
    return ffmpeg(f"mcompand=0.005\\,0.1 {curve} 300 | 0.003\\,0.05 {curve} 1400 | {highest}")


def _compressor(r: Rng) -> Command:
    level = {"threshold_db": r.uniform(-34, -24), "ratio": r.uniform(2.5, 8)}
    return pedalboard("Compressor", **level, attack_ms=log_uniform(r, 1, 20), release_ms=log_uniform(r, 60, 500))


def _clipped_microphone(r: Rng) -> Command:
    """A microphone that clips at a share of the peak that it hears."""
    share = r.uniform(0.25, 0.5)

    def run(x: Array) -> Array:
        most = share * np.abs(x).max()
        return _filtered(x, f"aeval='clip(val(0),-{most:.5f},{most:.5f})'")

    return Command(f"ffmpeg -af aeval=clip at {share:.2f} of the peak", run)


# fmt: off
TUNING: tuple[Program, ...] = (
    Program("sox bass, treble", "source", ("equaliser",),
            lambda r: sox("bass", f"{either(r, 3, 9):.1f}", "treble", f"{either(r, 3, 9):.1f}")),
    Program("swh triplePara", "source", ("equaliser",), _parametric),
    Program("swh dj_eq", "source", ("equaliser",), lambda r: ladspa("dj_eq_1901", "dj_eq_mono", *gains(r, 3, 6.0), rate=48000)),
    Program("sox echo", "room", ("early_path",), _sox_echo),
    Program("pyroomacoustics, microphone moved", "room", ("early_path",), None),
    Program("pyroomacoustics, robot moved", "room", ("early_path",), None),
    Program("swh gverb", "room", ("late_reverb",),
            lambda r: ladspa("gverb_1216", "gverb", r.uniform(8, 25), r.uniform(0.5, 1.2), 0.3, 0.8, 0, -70, r.uniform(-24, -16))),
    Program("sox reverb", "room", ("late_reverb",),
            lambda r: sox("reverb", f"{r.uniform(50, 90):.0f}", "50", f"{r.uniform(50, 100):.0f}", "100", "0", "-6")),
    Program("swh valve", "source", ("speaker_nonlinearity",), lambda r: ladspa("valve_1209", "valve", r.uniform(0.3, 0.9), r.uniform(0.1, 0.9))),
    Program("swh foverdrive", "source", ("speaker_nonlinearity",), lambda r: ladspa("foverdrive_1196", "foverdrive", r.uniform(1.5, 3))),
    Program("sox overdrive", "source", ("speaker_nonlinearity", "playback_gain"),  # its gain raises the level as well
            lambda r: sox("overdrive", f"{r.uniform(3, 12):.1f}", f"{r.uniform(5, 30):.0f}")),
    Program("swh fastLookaheadLimiter", "source", ("limiter", "compression"),  # a limiter is a compressor of infinite ratio
            lambda r: ladspa("fast_lookahead_limiter_1913", "fastLookaheadLimiter",
                             0, r.uniform(-18, -8), log_uniform(r, 0.03, 0.6), channels=2)),
    Program("swh hardLimiter", "source", ("speaker_nonlinearity", "limiter"),  # it clips, which an amplifier's limiter does as well
            lambda r: ladspa("hard_limiter_1413", "hardLimiter", r.uniform(-16, -8), 1, 0)),
    Program("swh hardLimiter behind the microphone", "microphone", ("mic_clipping",),
            lambda r: ladspa("hard_limiter_1413", "hardLimiter", r.uniform(-22, -16), 1, 0)),
    Program("swh sc4m", "source", ("compression",),
            lambda r: ladspa("sc4m_1916", "sc4m", r.uniform(0, 0.5), log_uniform(r, 2, 30), log_uniform(r, 60, 500),
                             r.uniform(-30, -20), r.uniform(2.5, 10), r.uniform(1, 8), r.uniform(0, 6))),
    Program("sox compand", "source", ("compression",), _sox_compand),
    Program("sox mcompand", "source", ("multiband_compression",), _sox_multiband),
    Program("webrtc noise suppression", "microphone", ("noise_suppression",), lambda r: webrtc(0, int(r.integers(1, 5)))),
    Program("webrtc gain control", "microphone", ("mic_agc",), lambda r: webrtc(int(r.integers(5, 20)), 0)),
    Program("speex", "source", ("codec",),
            lambda r: coded(f"speexenc --wideband --quality {r.integers(3, 9)} {{wav}} {{packed}}", "speexdec {packed} {out}")),
    Program("speex, packets lost", "source", ("codec",),
            lambda r: coded("speexenc --wideband --quality 8 {wav} {packed}",
                            f"speexdec --packet-loss {r.integers(3, 15)} {{packed}} {{out}}")),
    Program("swh buttlow", "source", ("bandlimit", "equaliser"),  # of second order: 12 dB an octave
            lambda r: ladspa_by_rate("butterworth_1902", "buttlow_iir", r.uniform(1800, 4500), r.uniform(0.6, 1.41))),
    Program("sox sinc", "source", ("bandlimit",), lambda r: sox("sinc", f"-{r.uniform(2500, 5500):.0f}")),
    Program("sox speed", "source", ("clock_drift",), lambda r: sox("speed", f"{1 + either(r, 3e-5, 3e-4):.6f}")),
    Program("sox gain", "source", ("playback_gain",), lambda r: sox("gain", f"{volume(r):.1f}")),
    Program("sox equalizer, narrow", "source", ("chassis_resonance", "equaliser"),  # one peak, which is an equaliser's band as well
            lambda r: sox("equalizer", f"{log_uniform(r, 250, 4000):.0f}", f"{r.uniform(8, 30):.1f}q", f"{r.uniform(6, 15):.1f}")),
    Program("sox tremolo", "source", ("unknown",), lambda r: sox("tremolo", f"{r.uniform(3, 9):.1f}", f"{r.uniform(40, 80):.0f}")),
    Program("sox flanger", "source", ("unknown",),
            lambda r: sox("flanger", 0, f"{r.uniform(1, 4):.1f}", 0, 70, f"{r.uniform(0.5, 2):.1f}")),
)
"""SoX, swh-plugins, pyroomacoustics, Speex, WebRTC."""

REPORTING: tuple[Program, ...] = (
    Program("tap equalizer", "source", ("equaliser",), lambda r: ladspa(
            "tap_eq", "tap_equalizer", 0, *gains(r, 5), 0, 0, 100, 200, 450, 1000, 2200, 4500, 12000, 15000)),
    Program("caps Eq10", "source", ("equaliser",), lambda r: ladspa("caps", "Eq10", 0, 0, 0, *gains(r, 6), 0)),
    Program("caps CabinetIII", "source", ("equaliser",),
            lambda r: ladspa("caps", "CabinetIII", int(r.integers(0, 17)), 0, r.uniform(-3, 3))),
    Program("pedalboard HighShelfFilter", "source", ("equaliser",),
            lambda r: pedalboard("HighShelfFilter", cutoff_frequency_hz=r.uniform(900, 3500), gain_db=either(r, 3, 9))),
    Program("ffmpeg firequalizer", "source", ("equaliser",), _firequalizer),
    Program("ffmpeg aecho", "room", ("early_path",), _aecho),
    Program("cmt delay_0.01s", "room", ("early_path",),
            lambda r: ladspa("cmt", "delay_0.01s", r.uniform(0.0015, 0.009), r.uniform(0.15, 0.4))),
    Program("tap reverb", "room", ("late_reverb",),
            lambda r: ladspa("tap_reverb", "tap_reverb", r.uniform(700, 2000), 0, r.uniform(-22, -12),
                             1, 1, 1, 0, int(r.integers(0, 43)), channels=2)),
    Program("caps Plate", "room", ("late_reverb",),
            lambda r: ladspa("caps", "Plate", 0.7, r.uniform(0.3, 0.7), 0.4, r.uniform(0.1, 0.3))),
    Program("cmt freeverb3", "room", ("late_reverb",),
            lambda r: ladspa("cmt", "freeverb3", 0, r.uniform(0.3, 0.7), 0.3, r.uniform(0.1, 0.3), 0.7, 0.5, channels=2)),
    Program("tap sigmoid", "source", ("speaker_nonlinearity", "playback_gain"),  # its pre-gain raises the level
            lambda r: ladspa("tap_sigmoid", "tap_sigmoid", r.uniform(2, 10), r.uniform(-6, 0))),
    Program("tap tubewarmth", "source", ("speaker_nonlinearity",),
            lambda r: ladspa("tap_tubewarmth", "tap_tubewarmth", r.uniform(2, 9), r.uniform(0, 10))),
    Program("invada tube", "source", ("speaker_nonlinearity",),
            lambda r: ladspa("inv_tube", "invada_mono_tube_module_0_1", r.uniform(3, 15), r.uniform(-0.4, 0.4), 0, 75)),
    Program("ffmpeg asoftclip", "source", ("speaker_nonlinearity",),
            lambda r: ffmpeg(f"asoftclip=type={r.choice(['tanh', 'atan', 'cubic', 'exp', 'alg'])}")),
    Program("ffmpeg alimiter", "source", ("limiter", "compression"), _limiter),
    Program("tap limiter", "source", ("limiter", "compression"), lambda r: ladspa("tap_limiter", "tap_limiter", r.uniform(-18, -8), 0)),
    Program("pedalboard Limiter", "source", ("limiter", "compression"),
            lambda r: pedalboard("Limiter", threshold_db=r.uniform(-24, -14), release_ms=log_uniform(r, 40, 400))),
    Program("ffmpeg acompressor", "source", ("compression",), _acompressor),
    Program("invada compressor", "source", ("compression",),
            lambda r: ladspa("inv_compressor", "invada_mono_compressor_module_0_1", r.uniform(0, 0.6), log_uniform(r, 1, 20),
                             log_uniform(r, 60, 500), r.uniform(-34, -24), r.uniform(2.5, 8), 0, 0)),
    Program("pedalboard Compressor", "source", ("compression",), _compressor),
    Program("ffmpeg mcompand", "source", ("multiband_compression",), _mcompand),
    Program("ffmpeg afftdn", "microphone", ("noise_suppression",), lambda r: ffmpeg(f"afftdn=nr={r.uniform(8, 25):.0f}:nf=-50:tn=1")),
    Program("noisereduce", "microphone", ("noise_suppression",),
            lambda r: noisereduce(stationary=True, prop_decrease=r.uniform(0.6, 1.0))),
    Program("ffmpeg dynaudnorm", "microphone", ("mic_agc",), lambda r: ffmpeg(f"dynaudnorm=f={r.integers(200, 800)}:g=5:m=6")),
    Program("vlevel", "microphone", ("mic_agc",),
            lambda r: ladspa("vlevel-ladspa", "vlevel_mono", r.uniform(0.3, 1.5), r.uniform(0.3, 0.7), 1, r.uniform(3, 8), 0)),
    Program("toast", "source", ("codec", "bandlimit"),  # narrow band, too
            lambda r: coded("sox {wav} -t gsm {packed}", "sox -t gsm -r 8000 {packed} {out}", 8000)),
    Program("lame", "source", ("codec",),
            lambda r: coded(f"lame -m m -b {r.choice([8, 16, 24, 32])} {{wav}} {{packed}}", "lame --decode {packed} {out}")),
    Program("opus, packets lost", "source", ("codec",),
            lambda r: coded("opusenc --bitrate 32 {wav} {packed}",
                            f"opusdec --rate 16000 --packet-loss {r.integers(3, 15)} {{packed}} {{out}}")),
    Program("pedalboard Clipping", "microphone", ("mic_clipping",), lambda r: pedalboard("Clipping", threshold_db=r.uniform(-22, -16))),
    Program("pedalboard LadderFilter", "source", ("bandlimit", "equaliser"),  # 24 dB an octave, and a colour below
            lambda r: pedalboard("LadderFilter", cutoff_hz=r.uniform(2000, 4500), resonance=0.0, drive=1.0)),
    Program("ffmpeg asetrate", "source", ("clock_drift",),
            lambda r: ffmpeg(f"aresample=160000,asetrate={160000 + round(either(r, 6, 45))},aresample=16000")),
    Program("ffmpeg volume", "source", ("playback_gain",), lambda r: ffmpeg(f"volume={volume(r):.1f}dB")),
    Program("ffmpeg tremolo", "source", ("unknown",),
            lambda r: ffmpeg(f"tremolo=f={r.uniform(3, 9):.1f}:d={r.uniform(0.4, 0.8):.2f}")),
    Program("pedalboard Chorus", "source", ("unknown",),
            lambda r: pedalboard("Chorus", rate_hz=r.uniform(0.5, 3), depth=r.uniform(0.1, 0.3), mix=r.uniform(0.3, 0.5))),
)
"""ffmpeg, tap, caps, cmt, invada, vlevel, LAME, Opus, GSM, pedalboard, noisereduce."""

UNSEEN: tuple[Program, ...] = (
    Program("zam EQ2", "source", ("equaliser",),
            lambda r: ladspa("ZamEQ2-ladspa", "ZamEQ2", either(r, 3, 9), r.uniform(0.5, 2), log_uniform(r, 300, 1200),
                             either(r, 3, 9), r.uniform(0.5, 2), log_uniform(r, 1200, 5000), either(r, 1, 6), 200,
                             either(r, 1, 6), 3000, 0, 0, rate=48000)),
    Program("zam GEQ31", "source", ("equaliser",),
            lambda r: ladspa("ZamGEQ31-ladspa", "ZamGEQ31", 0, *np.interp(np.arange(29), np.arange(0, 32, 4), gains(r, 8)), rate=48000)),
    Program("fil Parametric1", "source", ("equaliser",),
            lambda r: ladspa("filters", "Parametric1", 1, 0, *(v for low in (150, 400, 1000, 2500) for v in
                             (1, low * r.uniform(1, 2), r.uniform(0.5, 2), either(r, 2, 9))), rate=48000)),
    Program("guitarix echo", "room", ("early_path",),
            lambda r: ladspa("guitarix_echo", "guitarix_echo", r.uniform(10, 40), r.uniform(1.5, 12))),
    Program("guitarix freeverb", "room", ("late_reverb",),
            lambda r: ladspa("guitarix_freeverb", "guitarix_freeverb", r.uniform(0.3, 0.8), r.uniform(0.2, 0.6), r.uniform(0.1, 0.3))),
    Program("zita reverb", "room", ("late_reverb",),
            lambda r: ladspa("zita-reverbs", "zita-reverb", 0.02, 200, 1, 1, 6000, 160, 0, 2500, 0, r.uniform(0.05, 0.3), channels=2)),
    Program("zam AutoSat", "source", ("speaker_nonlinearity", "playback_gain"),  # it raises the level as well
            lambda r: ladspa("ZamAutoSat-ladspa", "ZamAutoSat")),
    Program("zam Comp", "source", ("compression",),
            lambda r: ladspa("ZamComp-ladspa", "ZamComp", log_uniform(r, 1, 20), log_uniform(r, 60, 500), r.uniform(0, 6),
                             r.uniform(2.5, 8), r.uniform(-34, -24), 0, 1, 0, channels=2)),
    Program("guitarix compressor", "source", ("compression",),
            lambda r: ladspa("guitarix_compressor", "guitarix_compressor", r.uniform(0, 6), r.uniform(2.5, 8), r.uniform(-34, -24),
                             log_uniform(r, 0.001, 0.02), log_uniform(r, 0.06, 0.5), 0)),
    Program("zam MaximX2", "source", ("limiter", "compression"),
            lambda r: ladspa("ZaMaximX2-ladspa", "ZaMaximX2", log_uniform(r, 5, 80), *2 * [r.uniform(-20, -10)], channels=2)),
    Program("zam MultiCompX2", "source", ("multiband_compression",),
            lambda r: ladspa("ZaMultiCompX2-ladspa", "ZaMultiCompX2", *3 * [log_uniform(r, 2, 20)], *3 * [log_uniform(r, 60, 400)],
                             0, 0, 0, *r.uniform(2, 8, 3), *r.uniform(-45, -25, 3), 0, 0, 0, log_uniform(r, 300, 1200),
                             log_uniform(r, 1500, 4000), 1, 1, 1, 0, 0, 0, 1, 0, channels=2)),
    Program("blop lp4pole", "source", ("bandlimit", "equaliser"),  # 24 dB an octave, and a colour below
            lambda r: ladspa_by_rate("lp4pole_1671", "lp4pole_fcrcia_oa", r.uniform(2000, 4500), 0)),
    Program("vorbis", "source", ("codec",), lambda r: coded(f"oggenc -q {r.integers(-1, 3)} -o {{packed}} {{wav}}", "oggdec -o {out} {packed}")),
    Program("sbc", "source", ("codec",),
            lambda r: coded(f"ffmpeg -y -i {{wav}} -c:a sbc -b:a {r.integers(24, 64)}k -f sbc {{packed}}", "ffmpeg -y -f sbc -i {packed} {out}")),
    Program("aac", "source", ("codec",),
            lambda r: coded(f"ffmpeg -y -i {{wav}} -c:a aac -b:a {r.integers(12, 32)}k -f adts {{packed}}", "ffmpeg -y -i {packed} {out}")),
)
"""zam, fil, guitarix, zita, blop, Vorbis, SBC, AAC: nothing was chosen on them."""
UNTRIED: tuple[Program, ...] = (
    Program("sox equalizer", "source", ("equaliser",),
            lambda r: sox("equalizer", f"{log_uniform(r, 300, 4000):.0f}", f"{r.uniform(0.5, 2):.2f}q", f"{either(r, 5, 10):.1f}")),
    Program("ffmpeg superequalizer", "source", ("equaliser",), lambda r: ffmpeg("superequalizer=" + ":".join(
        f"{band}b={10 ** (db / 20):.3f}" for band, db in enumerate(np.interp(np.arange(13), np.arange(0, 15, 3), gains(r, 5)), 3)))),
    Program("ffmpeg atilt", "source", ("equaliser",),
            lambda r: ffmpeg(f"atilt=freq={r.uniform(800, 2500):.0f}:slope={either(r, 0.2, 0.6):.2f}:width=3000:order=5")),
    Program("dpf 3BandEQ", "source", ("equaliser",), lambda r: ladspa(
        "3BandEQ-ladspa", "3BandEQ", *gains(r, 3), 0, r.uniform(200, 600), r.uniform(1500, 4000), channels=2)),
    Program("sox band", "source", ("bandlimit", "equaliser"), lambda r: sox("band", f"{r.uniform(800, 1600):.0f}", f"{r.uniform(1500, 3000):.0f}")),
    Program("ffmpeg lowpass", "source", ("bandlimit", "equaliser"), lambda r: ffmpeg(f"lowpass=f={r.uniform(1500, 3500):.0f}:p=2")),
    Program("sox echos", "room", ("early_path",), lambda r: sox("echos", 1.0, 1.0, *(
        word for ms in echoes_ms(r, 2) for word in (ms, round(float(r.uniform(0.15, 0.4)), 2))))),
    Program("ffmpeg adelay, amix", "room", ("early_path",), lambda r: ffmpeg(
        f"asplit[a][b];[b]adelay={r.uniform(2, 9):.0f},volume={either(r, 0.2, 0.5):.2f}[c];[a][c]amix=normalize=0")),
    Program("dpf MVerb", "room", ("late_reverb",), lambda r: ladspa(
        "MVerb-ladspa", "MVerb", r.uniform(20, 70), 80, 60, 0, r.uniform(10, 25), r.uniform(30, 60), r.uniform(20, 60), 100,
        r.uniform(20, 60), channels=2)),
    Program("dpf MaFreeverb", "room", ("late_reverb",), lambda r: ladspa(
        "MaFreeverb-ladspa", "MaFreeverb", r.uniform(0.1, 0.3), 0.7, r.uniform(0.3, 0.7), 0.4, channels=2)),
    Program("dpf SoulForce", "source", ("speaker_nonlinearity", "playback_gain"),
            lambda r: ladspa("SoulForce-ladspa", "SoulForce", r.uniform(0.5, 0.9), 0, 0, 1, channels=2)),
    Program("ffmpeg aeval, one side bent", "source", ("speaker_nonlinearity",),
            lambda r: ffmpeg(f"aeval='val(0)-{r.uniform(0.2, 0.8):.2f}*val(0)*val(0)'")),
    Program("sox contrast", "source", ("speaker_nonlinearity", "playback_gain"), lambda r: sox("contrast", f"{r.uniform(20, 90):.0f}")),
    Program("ffmpeg aeval, clipped", "source", ("speaker_nonlinearity", "limiter"),
            lambda r: ffmpeg(f"aeval='clip(val(0),-{r.uniform(0.08, 0.25):.3f},{r.uniform(0.08, 0.25):.3f})'")),
    Program("ffmpeg aeval behind the microphone", "microphone", ("mic_clipping",), _clipped_microphone),
    Program("ffmpeg compand", "source", ("compression",), lambda r: ffmpeg(
        f"compand=attacks={log_uniform(r, 0.003, 0.03):.3f}:decays={log_uniform(r, 0.08, 0.5):.2f}:"
        f"points=-90/-90|{(knee := r.uniform(-45, -30)):.0f}/{knee:.0f}|0/{knee * (1 - 1 / r.uniform(2, 6)):.0f}")),
    Program("ffmpeg sidechaincompress by itself", "source", ("compression",), lambda r: ffmpeg(
        f"asplit[a][b];[a][b]sidechaincompress=threshold={10 ** (r.uniform(-34, -22) / 20):.3f}:ratio={r.uniform(2.5, 8):.1f}:"
        f"attack={log_uniform(r, 2, 30):.1f}:release={log_uniform(r, 60, 500):.0f}")),
    Program("ffmpeg agate", "source", ("unknown",), lambda r: ffmpeg(
        f"agate=threshold={10 ** (r.uniform(-20, -12) / 20):.3f}:ratio={r.uniform(2, 6):.1f}:attack=5:release={log_uniform(r, 50, 300):.0f}")),
    Program("ffmpeg speechnorm", "microphone", ("mic_agc",), lambda r: ffmpeg(f"speechnorm=e={r.uniform(3, 8):.1f}:r=0.0005:f=0.002")),
    Program("ffmpeg afreqshift", "source", ("unknown",), lambda r: ffmpeg(f"afreqshift=shift={either(r, 0.1, 2):.2f}")),
    Program("ffmpeg apulsator", "source", ("unknown",), lambda r: ffmpeg(
        f"pan=stereo|c0=c0|c1=c0,apulsator=hz={r.uniform(0.7, 6):.1f}:amount={r.uniform(0.3, 0.8):.2f}:offset_r=0,pan=mono|c0=c0")),
    Program("sox chorus", "source", ("unknown",), lambda r: sox(
        "chorus", 1, 1, f"{r.uniform(20, 40):.0f}", f"{r.uniform(0.2, 0.5):.2f}", f"{r.uniform(0.2, 1):.1f}", f"{r.uniform(0.5, 2):.1f}", "-s")),
    Program("mp2", "source", ("codec",),
            lambda r: coded(f"ffmpeg -y -i {{wav}} -c:a mp2 -b:a {r.choice([16, 24, 32])}k -f mp2 {{packed}}", "ffmpeg -y -f mp3 -i {packed} {out}")),
)
"""Programs of DPF and further ones of SoX and ffmpeg: run once (--seed 6157 --count 30), after a change of the diagnosis was done."""
# fmt: on

HALVES = {"tuning": TUNING, "reporting": REPORTING, "unseen": UNSEEN, "untried": UNTRIED}
FAN = Program("fan", "fan", ("fan_noise",), None)
COMBINED: tuple[tuple[str, ...], ...] = (
    ("swh triplePara", "swh foverdrive"),
    ("sox gain", "sox reverb"),
    ("sox compand", "pyroomacoustics, robot moved"),
    ("swh foverdrive", "sox speed"),
    ("sox reverb", "fan"),
    ("swh triplePara", "swh foverdrive", "sox reverb"),
    ("sox gain", "sox speed", "fan"),
)
"""What happens together: an equaliser and a clipper, a volume and a room, a compressor and another place, a clipper and a clock, a room
and a fan, and three at once. Each of the programs has one right name."""


def programs_of(half: str, index: int) -> tuple[Program, ...]:
    """Every EVERY-th case is a control, without any; the others take the half's programs, or its combinations, in turn."""
    if index % EVERY == EVERY - 1:
        return ()
    turn = index - index // EVERY
    if half != "combined":
        return (HALVES[half][turn % len(HALVES[half])],)
    known = {program.name: program for program in (*TUNING, FAN)}
    return tuple(known[name] for name in COMBINED[turn % len(COMBINED)])


SETS = (*sorted(HALVES), "combined")


def moved(rng: Rng, place: Place, program: Program) -> tuple[Place, str]:
    """The microphone some centimetres, or the robot some tenths of a metre, away in the same room."""
    if "robot" in program.name:
        step = rng.uniform(0.3, 1.2) * direction(rng) * np.array([1.0, 1.0, 0.1])
        return place.robot_moved(step), f"robot moved by {np.linalg.norm(step):.2f} m"
    step = rng.uniform(0.01, 0.06) * direction(rng)
    return place.microphone_moved(step), f"microphone moved by {100 * np.linalg.norm(step):.1f} cm"


def through(rng: Rng, scene: Scene, chain: Chain, program: Program) -> tuple[Chain, str]:
    """The chain with the program inserted at its place, at a setting drawn at random, and the words for that setting."""
    if program is FAN:
        changed, setting = fan_noise(rng, scene, chain, "clear")
        return changed, f"fan {setting['kind']}, {setting['change_db']:.1f} dB"
    start, fade, response = chain.paths[0]
    if program.draw is None:
        place, words = moved(rng, scene.moved, program)
        return replace(chain, paths=((start, fade, place.response()),)), words
    command = program.draw(rng)
    if program.place == "source":
        return replace(chain, played=command(chain.played)), command.words
    if program.place == "microphone":
        return replace(chain, microphone=(*chain.microphone, command)), command.words
    longer = np.pad(response, (0, round(TAIL_S * RATE)))
    return replace(chain, paths=((start, fade, command(longer)),)), command.words


def hidden(rng: Rng, scene: Scene, programs: Sequence[Program]) -> tuple[Array, list[str], float]:
    """The recording (n,) through all programs, the words for their settings, and the least that one of them changes, dB over the fan."""
    chain, said, mic, least = scene.usual, [], scene.record(scene.usual), np.inf
    for program in programs:
        chain, words = through(rng, scene, chain, program)
        before, mic = mic, scene.record(chain)
        said.append(words)
        least = min(least, scene.over_fan_db(put_back(mic, before) - before))
    return mic, said, least


def is_a_volume(scene: Scene, change: Array) -> bool:
    """Whether a change of the recording (n,) is a turned volume but for less than LEAST_DB over the fan: a compressor that always works is one."""
    voice = scene.echo(scene.usual)
    turned = np.dot(change, voice) / np.dot(voice, voice) * voice
    return scene.over_fan_db(change - turned) < LEAST_DB


def make_case(seed: int, index: int, half: str, voices: Voices) -> tuple[dict[str, Array], dict]:
    """Signals by name (n,) and the contents of truth.json, for case index of this seed and half."""
    rng = np.random.default_rng([seed, SETS.index(half), index])
    programs = programs_of(half, index)
    voice = str(rng.choice(sorted(voices)))
    scene = draw_scene(rng, read_reference(rng, voices[voice]), rng.uniform(*ROBOT_OVER_FAN_DB))
    usual = scene.record(scene.usual)
    for _ in range(TRIES):
        mic, said, least = hidden(rng, scene, programs)
        if least >= LEAST_DB:
            break
    change = put_back(mic, usual) - usual
    change_db = scene.over_fan_db(change)
    right = [program.right[0] for program in programs] or ["none"]
    also = [name for program in programs for name in program.right[1:]]
    if len(programs) == 1 and change_db >= LEAST_DB and is_a_volume(scene, change):
        also.append("playback_gain")
    strength = "clear" if change_db >= CLEAR_DB else "moderate"
    truth = {"effects": right, "also": also, "raw": [program.name for program in programs] or ["none"]}
    truth |= {"strength": strength if programs else "control", "setting": "; ".join(said)}
    truth |= {"effect_to_noise_db": change_db, "tolerances": scene.tolerances}
    truth |= {"robot_over_fan_db": decibels(power(scene.echo(scene.usual)) / scene.fan_power)}
    return scale(scene.signals | {"mic": mic}, {}), truth | {"voice": voice, "seed": [seed, index]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, required=True, nargs="+", metavar="DIR", help="the robot's voices")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--half", choices=SETS, required=True)
    parser.add_argument("--count", type=int, default=40, help="cases (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    half, voices = options.half, read_voices(options.voices)
    for index in tqdm(range(options.count), unit="case", desc=half):
        signals, truth = make_case(options.seed, index, half, voices)
        write_item(options.output / f"{half}_{index:03d}", signals, "truth", truth)


if __name__ == "__main__":
    main()
