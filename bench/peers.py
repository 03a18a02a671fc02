"""Public echo cancellers: SpeexDSP (the system's library, through ctypes), WebRTC AEC3 (pywebrtc-audio), echoff and voiceclean."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
from scipy.signal import resample_poly

from edgefilter.audio.raw import of_pcm16, to_pcm16
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples, as_samples

FRAME = 256
"""SpeexDSP samples per call, 16 ms; its manual asks for 10-20 ms."""
TAIL = 6400
"""SpeexDSP filter length, 400 ms: an office's reverberation."""
_SET_ECHO_RATE, _SET_ECHO_STATE = 24, 24  # SPEEX_ECHO_SET_SAMPLING_RATE, SPEEX_PREPROCESS_SET_ECHO_STATE
SUPPRESSED_DELAY = FRAME
"""Samples by which SpeexDSP's preprocessor delays the signal (its windows overlap by one frame); removed here."""
AEC3_FRAME = 160
AEC3_DELAY = 128
"""Samples by which AEC3 delays the signal (it regroups frames of 80 samples into blocks of 64); removed here."""
ECHOFF_TIMES, ECHOFF_DELAY = 3, 143
"""By which its rate is ours, and samples at our rate by which it delays the signal; removed here."""
VOICECLEAN_FRAME = 640
"""Samples that it takes at a time, 40 ms."""


def speexdsp(mic: Samples, ref: Samples, suppress: bool = False) -> Samples:
    """SpeexDSP's echo canceller (MDF, Valin 2007), (n,) float32 for mic and ref (n,), aligned with the input.

    suppress: with its preprocessor behind (residual echo, noise; default strengths), as in its manual. Raises
    UsageError where libspeexdsp.so.1 is missing.
    """
    mic, ref = as_samples(mic, "mic"), as_samples(ref, "ref")
    delay = SUPPRESSED_DELAY if suppress else 0
    padding = (0, -(-(mic.size + delay) // FRAME) * FRAME - mic.size)
    near, far = (to_pcm16(np.pad(x, padding))[0] for x in (mic, ref))
    out = np.zeros_like(near)
    with speexdsp_frames(suppress) as step:
        for at in range(0, near.size, FRAME):
            step(near[at : at + FRAME], far[at : at + FRAME], out[at : at + FRAME])
    return out[delay : delay + mic.size].astype(np.float32) / 32768.0


speexdsp_suppressed = partial(speexdsp, suppress=True)


def aec3(mic: Samples, ref: Samples) -> Samples:
    """WebRTC AEC3 with its own delay estimator and high-pass, (n,) float32 for mic and ref (n,), aligned."""
    named = ((mic, "mic"), (ref, "ref"))
    mic, ref = (np.append(as_samples(x, name), np.zeros(AEC3_DELAY, np.float32)) for x, name in named)
    return np.asarray(aec3_frames()(mic, ref), np.float32)[AEC3_DELAY:]


def aec3_frames() -> Callable[[Samples, Samples], object]:
    """A new canceller as a function of mic and ref, (n,) float32; it works on AEC3_FRAME samples at a time, 10 ms."""
    try:
        from pywebrtc_audio import EchoCanceller
    except ImportError as error:
        raise UsageError("AEC3 needs the package pywebrtc-audio: pip install pywebrtc-audio") from error
    return EchoCanceller(sample_rate=SAMPLE_RATE).process


def echoff_processor() -> type:
    """Its canceller, not made yet: LiveKit's runtime must not begin in a process that forks others."""
    try:
        from echoff import WebRtcAecProcessor
    except ImportError as error:
        raise UsageError("echoff is missing: pip install echoff (Python 3.11 or newer)") from error
    return WebRtcAecProcessor


def echoff(mic: Samples, ref: Samples) -> Samples:
    """Echoff 0.3, LiveKit's WebRTC processing at 48 kHz with echoff's settings, (n,) float32 for mic and ref (n,), aligned."""
    canceller = echoff_processor()()
    mic, ref = as_samples(mic, "mic"), as_samples(ref, "ref")
    padding = (0, -(-(mic.size + ECHOFF_DELAY) // AEC3_FRAME) * AEC3_FRAME - mic.size)
    far, near = (resample_poly(np.pad(x, padding), ECHOFF_TIMES, 1).tolist() for x in (ref, mic))
    out = resample_poly(np.array(canceller.process_pair(far, near)), 1, ECHOFF_TIMES)
    return out[ECHOFF_DELAY : ECHOFF_DELAY + mic.size].astype(np.float32)


def voiceclean(mic: Samples, ref: Samples) -> Samples:
    """Voiceclean 0.3's echo canceller, (n,) float32 for mic and ref (n,): chunks of 40 ms that correlate with what was played are masked."""
    try:
        from voiceclean.aec import AEC
    except ImportError as error:
        raise UsageError("voiceclean is missing: pip install voiceclean") from error
    mic, ref = as_samples(mic, "mic"), as_samples(ref, "ref")
    padding, canceller, out = (0, -mic.size % VOICECLEAN_FRAME), AEC(sample_rate=SAMPLE_RATE), b""
    frames = (to_pcm16(np.pad(x, padding))[0].reshape(-1, VOICECLEAN_FRAME) for x in (mic, ref))
    for near, far in zip(*frames, strict=True):
        canceller.feed_reference(far.tobytes())
        out += canceller.process(near.tobytes())
    return of_pcm16(out, 1)[: mic.size, 0]


@contextmanager
def speexdsp_frames(suppress: bool) -> Iterator[Callable[[np.ndarray, np.ndarray, np.ndarray], None]]:
    """A new canceller as a function of near, far and out, (FRAME,) contiguous int16 each, that fills out."""
    library = _load()
    echo = ctypes.c_void_p(library.speex_echo_state_init(FRAME, TAIL))
    library.speex_echo_ctl(echo, _SET_ECHO_RATE, ctypes.byref(ctypes.c_int(SAMPLE_RATE)))
    preprocessor = ctypes.c_void_p(library.speex_preprocess_state_init(FRAME, SAMPLE_RATE)) if suppress else None
    if preprocessor:
        library.speex_preprocess_ctl(preprocessor, _SET_ECHO_STATE, echo)

    def step(near: np.ndarray, far: np.ndarray, out: np.ndarray) -> None:
        library.speex_echo_cancellation(echo, near.ctypes.data, far.ctypes.data, out.ctypes.data)
        if preprocessor:
            library.speex_preprocess_run(preprocessor, out.ctypes.data)

    try:
        yield step
    finally:
        if preprocessor:
            library.speex_preprocess_state_destroy(preprocessor)
        library.speex_echo_state_destroy(echo)


def _load() -> ctypes.CDLL:
    try:
        library = ctypes.CDLL("libspeexdsp.so.1")
    except OSError as error:
        remedy = "expected SpeexDSP 1.2: apt-get install libspeexdsp1"
        raise UsageError(f"libspeexdsp.so.1 cannot be loaded, {remedy}") from error
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    for name, result, arguments in (
        ("speex_echo_state_init", pointer, (integer, integer)),
        ("speex_echo_state_destroy", None, (pointer,)),
        ("speex_echo_ctl", integer, (pointer, integer, pointer)),
        ("speex_echo_cancellation", None, (pointer, pointer, pointer, pointer)),
        ("speex_preprocess_state_init", pointer, (integer, integer)),
        ("speex_preprocess_state_destroy", None, (pointer,)),
        ("speex_preprocess_ctl", integer, (pointer, integer, pointer)),
        ("speex_preprocess_run", integer, (pointer, pointer)),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
