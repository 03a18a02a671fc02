"""Other people's programs as functions from samples to samples: SoX, ffmpeg, LADSPA plugins, speech codecs, PyPI packages.

None of them is needed by anything but bench.simulate.wild. Debian: sox ffmpeg swh-plugins tap-plugins cmt caps
invada-studio-plugins-ladspa zam-plugins vlevel lame opus-tools speex libgsm-tools. PyPI: pedalboard noisereduce
webrtc-noise-gain.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal

from bench.simulate.simulated_robot import RATE, Array

LADSPA = "/usr/lib/ladspa"
RAW = ("-f", "f32le", "-ac", "1", "-ar", str(RATE))


@dataclass(frozen=True)
class Command:
    """One setting of a program: the words that its manual knows it by, and what it makes of samples (n,) at 16 kHz."""

    words: str
    run: Callable[[Array], Array]

    def __call__(self, x: Array) -> Array:
        """(n,) x through the program, put back in time by whole samples."""
        return put_back(self.run(x), x)


def put_back(y: Array, x: Array) -> Array:
    """(n,) y, of any length, at the lag of whole samples at which it is most like x (n,)."""
    lags = signal.correlate(y[: 1 << 18], x[: 1 << 18], method="fft")
    lag = int(np.argmax(np.abs(lags))) - min(x.size, 1 << 18) + 1
    y = y[lag:] if lag >= 0 else np.concatenate([np.zeros(-lag), y])
    return np.pad(y, (0, max(x.size - y.size, 0)))[: x.size]


def sox(*effect: object) -> Command:
    """SoX with an effect and its arguments."""
    words = [str(word) for word in effect]
    raw = ["-t", "f32", "-r", str(RATE), "-c", "1", "-"]
    return Command("sox " + " ".join(words), lambda x: _piped(["sox", "-V1", "-R", *raw, *raw, *words], x))


def ffmpeg(filters: str) -> Command:
    """The audio filters of ffmpeg."""
    return Command(f"ffmpeg -af {filters}", lambda x: _filtered(x, filters))


def ladspa(file: str, label: str, *controls: float, channels: int = 1, rate: int = RATE) -> Command:
    """One channel through a LADSPA plugin with that many inputs, its controls in their order; ffmpeg is the host.

    rate: at which it runs, for a plugin that is at home at that of studios only.
    """
    values = "|".join(f"c{i}={value:g}" for i, value in enumerate(controls))
    plugin = f"ladspa=f={file}:p={label}" + (f":c={values}" if controls else "")
    spread = "pan=stereo|c0=c0|c1=c0," if channels == 2 else ""
    return Command(
        f"{file} {label} {values}", lambda x: _filtered(x, f"aresample={rate},{spread}{plugin},pan=mono|c0=c0")
    )


def ladspa_by_rate(file: str, label: str, *controls: float) -> Command:
    """The same for a plugin whose controls have bounds in parts of the sampling rate, which ffmpeg does not know; SoX is the host."""
    return sox("ladspa", f"{LADSPA}/{file}.so", label, *(f"{value:g}" for value in controls))


def coded(encode: str, decode: str, rate: int = RATE) -> Command:
    """A codec's own two programs, as shell words with {wav} (16 bit), {packed} and {out} (a WAV file)."""

    def run(x: Array) -> Array:
        with tempfile.TemporaryDirectory() as folder:
            paths = {name: Path(folder, f"{name}.wav") for name in ("wav", "packed", "out")}
            sf.write(paths["wav"], signal.resample_poly(x, rate, RATE), rate, subtype="PCM_16")
            for line in (encode, decode):
                subprocess.run(line.format(**paths), shell=True, check=True, capture_output=True)
            y, heard = sf.read(paths["out"], dtype="float64")
        return signal.resample_poly(y if y.ndim == 1 else y[:, 0], RATE, heard)

    return Command(f"{encode} ; {decode}", run)


def pedalboard(name: str, **settings: float) -> Command:
    """One of pedalboard's effects."""

    def run(x: Array) -> Array:
        plugin = getattr(importlib.import_module("pedalboard"), name)(**settings)
        return np.asarray(plugin(x.astype(np.float32), RATE), float)

    return Command(f"pedalboard.{name}({_listed(settings)})", run)


def noisereduce(**settings: float) -> Command:
    """The spectral gate of noisereduce."""

    def run(x: Array) -> Array:
        return np.asarray(importlib.import_module("noisereduce").reduce_noise(y=x, sr=RATE, **settings), float)

    return Command(f"noisereduce.reduce_noise({_listed(settings)})", run)


def webrtc(auto_gain: int, noise_suppression: int) -> Command:
    """webrtc-noise-gain: target level -dBFS of its gain control, 0 to 4 for its noise suppression."""

    def run(x: Array) -> Array:
        device = importlib.import_module("webrtc_noise_gain").AudioProcessor(auto_gain, noise_suppression)
        pcm = np.round(32767 * np.clip(np.pad(x, (0, -x.size % 160)), -1, 1)).astype(np.int16).reshape(-1, 160)
        heard = b"".join(device.Process10ms(frame.tobytes()).audio for frame in pcm)
        return np.frombuffer(heard, np.int16)[: x.size] / 32768.0

    return Command(f"webrtc_noise_gain.AudioProcessor({auto_gain}, {noise_suppression})", run)


def _listed(settings: dict[str, float]) -> str:
    return ", ".join(f"{key}={value:.4g}" for key, value in settings.items())


def _filtered(x: Array, filters: str) -> Array:
    return _piped(["ffmpeg", "-v", "error", "-threads", "1", *RAW, "-i", "-", "-af", filters, *RAW, "-"], x)


def _piped(command: list[str], x: Array) -> Array:
    """(m,) what a program makes of 32-bit floats on its standard input; raises SystemExit with its own words."""
    try:
        done = subprocess.run(
            command, input=x.astype(np.float32).tobytes(), capture_output=True, env=os.environ | {"LADSPA_PATH": LADSPA}
        )
    except FileNotFoundError:
        raise SystemExit(
            f"{command[0]} was not found; bench/simulate/wild_tools.py says which packages are needed"
        ) from None
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed: {done.stderr.decode(errors='replace').strip()[-300:]}")
    return np.frombuffer(done.stdout, np.float32).astype(np.float64)
