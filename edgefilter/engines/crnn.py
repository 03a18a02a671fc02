"""'crnn': a recurrent network that corrects the Wiener mask on the linear stage's error, and says whether a human speaks."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from edgefilter.dsp import fourier
from edgefilter.engines.base import FrontEndKind
from edgefilter.engines.onnx_session import Model, expect_answer, expect_slots, find_model, open_model
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Output, Samples, Spectrum

EDGE_TYPE = "edgefilter-crnn"
EDGE_VERSION = 2
SPECTRA = ("error", "mic", "reference", "echo")
"""The graph's first inputs, each (1, bins, 2) float32, real and imaginary part."""
POWERS = ("noise_psd", "residual_psd")
"""Those that follow, each (1, bins) float32, as in Frame."""
SOUNDS = ("spectrum", "recognise")
"""Outputs of the graph, each (1, bins, 2) float32: the sound to listen to, and the one for a recogniser, which a graph may lack and
which is used while the robot is silent: only there it has fewer wrong words (models/MODELS.md)."""
VARIABLE = "EDGEFILTER_CRNN"
LOUDEST = 1.26
"""Most power of a frame of the answer, over the microphone's: 1 dB. The shipped network stays below; others are turned down."""
SURE = 100.0
"""Error power over the expected powers of noise and residual echo, 20 dB, from which on a bin is the human's while the robot
is silent, whatever the network says: it takes parts of a loud human for noise. Not used while the robot speaks, since what is
left of its echo may be as loud."""
SHARE_OF_SS = np.float32(0.4)
"""How much of the answer is that of `ss` where the robot is calibrated: it errs elsewhere than the network, and both
together err less than either; half would be as good, and leave more of a robot alone (models/MODELS.md). Without a
calibration, or with a learned path, it saves no word and costs a real loudspeaker's humans up to 2 dB."""
LOUD = 1.3e3, 6.3e3
"""Power of the loudest frame of microphone and reference, 31 and 38 dB, in the recordings that the network was trained on
(medians): the loudest so far is brought there."""
FADE = 0.1 ** (0.016 / 60.0)
"""Fall of the loudest power from frame to frame, 10 dB in a minute."""
FAINT = 1e-4
"""Power of the answer over the loudest frame of the microphone so far, -40 dB, below which it is nobody who interrupts: nine in
ten of the frames in which a human 20 to 26 dB below the robot is noticed are above it. What is left of one real loudspeaker,
with something soft behind it, sounds human to the network at -46 to -40 dB (tuning half). With -45 and -40 dB the same humans
are noticed as soon."""
LASTING = 3
"""Frames that must be as loud, so that no click counts."""


class Level(NamedTuple):
    """How loud a stream's microphone, or its reference, has been: power of the loudest frame so far, and of the LASTING latest."""

    loudest: float = 0.0
    latest: tuple[float, ...] = (0.0,) * LASTING

    def after(self, power: float) -> Level:
        """The same, and one more frame."""
        latest = (*self.latest[1:], power)
        return Level(max(min(latest), FADE * self.loudest), latest)

    def factor(self, usual: float) -> np.float32:
        """What brings the loudest frame to the usual power, 1 of a channel that was silent."""
        return np.float32(math.sqrt(usual / self.loudest) if self.loudest else 1.0)


CrnnState: TypeAlias = tuple[tuple[Samples, ...], Samples, tuple[Level, Level]]
"""The network's state tensors, all zeros at the start, the state of `ss`, and the levels of microphone and reference."""


class Crnn:
    """Runs an exported EdgeCrnn (export/network.py), one frame at a time.

    model: an ONNX file made by export/onnx_export.py; without one the file that the environment variable
    EDGEFILTER_CRNN names, else the package's own, whose recurrent layer has int8 weights: a hop reads them from
    memory, a quarter of the bytes. The file says which STFT it was trained for. profile: the robot; where it is calibrated,
    not learned, a share of the output is that of `ss`. Raises ModelError for a file that is not such a model.
    """

    name: ClassVar[str] = "crnn"
    front: ClassVar[FrontEndKind] = "full"

    def __init__(self, model: str | Path | None = None, profile: Profile | None = None) -> None:
        path = find_model(model, VARIABLE, "crnn_int8.onnx", "make one with 'python -m export.onnx_export --int8'")
        self.model = open_model(path, EDGE_TYPE, EDGE_VERSION)
        self.stft = self.model.stft
        self.lookahead = 0
        self._ss, self._ss_helps = SpectralSubtraction(self.stft), profile is not None and not profile.learned
        states = dict(self.model.states)
        spectrum = (1, self.stft.bins, 2)
        following = {f"next_{name}": shape for name, shape in states.items()}
        given = {slot.name for slot in self.model.session.get_outputs()}
        sounds = dict.fromkeys([name for name in SOUNDS if name in given] or SOUNDS, spectrum)
        outputs = {**sounds, "speech_probability": (1,), **following}
        powers = dict.fromkeys(POWERS, (1, self.stft.bins))
        expect_slots(self.model, {**dict.fromkeys(SPECTRA, spectrum), **powers, **states}, outputs)
        self._own = threading.local()
        expect_answer(path, self._first_answer)

    def _first_answer(self) -> list[Spectrum | Samples]:
        """What the network makes of a frame of noise."""
        noise = np.random.default_rng(0).standard_normal((4, self.stft.bins, 2), np.float32)
        mic, reference, echo, error = noise.view(np.complex64)[..., 0]
        power = np.ones(self.stft.bins, np.float32)
        frame, one = Frame(mic, reference, echo, error, power, power), np.float32(1.0)
        places = self._run(frame, self.initial_state()[0], one, one)
        return [places.sounds, places.probability, *places.next_states]

    def initial_state(self) -> CrnnState:
        tensors = tuple(np.zeros(shape, np.float32) for _, shape in self.model.states)
        return tensors, self._ss.initial_state(), (Level(), Level())

    def step(self, frame: Frame, state: CrnnState) -> tuple[Output, CrnnState]:
        tensors, mask, (mic, reference) = state
        heard = _power(frame.mic)
        mic, reference = mic.after(heard), reference.after(_power(frame.reference))
        scale = mic.factor(LOUD[0])
        places = self._run(frame, tensors, scale, reference.factor(LOUD[1]))
        sounds: Spectrum = places.sounds[: 1 + frame.idle] * np.float32(1.0 / scale)
        if self._ss_helps:
            masked, mask = self._ss.step(frame, mask)
            sounds = (1 - SHARE_OF_SS) * sounds + SHARE_OF_SS * masked.spectrum
        if frame.idle:
            sounds = _with_what_is_sure(sounds, frame)
        powers = [_power(sound) for sound in sounds]
        gain = _limited(max(powers), LOUDEST * heard)
        if gain is None:  # numbers have grown beyond all bounds: begin anew, and until then the linear stage alone
            return Output(frame.error, 0.0), self.initial_state()
        following = tuple(place.copy() for place in places.next_states)
        speaks = 0.0 if powers[0] < FAINT * mic.loudest else min(max(places.probability.item(), 0.0), 1.0)
        listen, *recognise = gain * sounds
        return Output(listen, speaks, *recognise), (following, mask, (mic, reference))

    def _run(self, frame: Frame, state: tuple[Samples, ...], mic: np.float32, reference: np.float32) -> Places:
        """Run the network on a frame whose microphone and reference are scaled by these factors; its answers are in what is returned."""
        if not hasattr(self._own, "places"):  # of the calling thread: several streams may share the engine
            self._own.places = Places(self.model)
        places: Places = self._own.places
        factors = {"reference": reference, **dict.fromkeys(POWERS, mic**2)}
        for name, inputs in places.inputs:
            np.multiply(getattr(frame, name), factors.get(name, mic), out=inputs)
        for place, tensor in zip(places.states, state):
            place[...] = tensor
        places.run()
        return places


class Places:
    """Where one frame's inputs go and its outputs come, of one thread; new arrays in each call take a tenth of a paced frame.

    inputs: (bins,) by the name of the Frame's field that goes there. sounds: (1 or 2, bins) complex64, in the order of SOUNDS.
    """

    def __init__(self, model: Model) -> None:
        self._session, self._binding = model.session, model.session.io_binding()
        given = {slot.name: np.zeros(slot.shape, np.float32) for slot in self._session.get_inputs()}
        made = {slot.name: np.zeros(slot.shape, np.float32) for slot in self._session.get_outputs()}
        for bind, places in ((self._binding.bind_input, given), (self._binding.bind_output, made)):
            for name, place in places.items():
                bind(name, "cpu", 0, np.float32, place.shape, place.ctypes.data)
        spectra = [(name, given[name].view(np.complex64).ravel()) for name in SPECTRA]
        self.inputs = [*spectra, *((name, given[name].ravel()) for name in POWERS)]
        self._sounds: list[Spectrum] = [made[name].view(np.complex64).ravel() for name in SOUNDS if name in made]
        self.probability = made["speech_probability"]
        self.states = [given[name] for name, _ in model.states]
        self.next_states = [made[f"next_{name}"] for name, _ in model.states]

    @property
    def sounds(self) -> Spectrum:
        return np.stack(self._sounds)

    def run(self) -> None:
        """From what stands in the places of the inputs to those of the outputs."""
        self._session.run_with_iobinding(self._binding)


def _with_what_is_sure(sounds: Spectrum, frame: Frame) -> Spectrum:
    """The sounds (sounds, bins), no bin softer than spectral subtraction (Boll 1979) leaves it of the error.

    SURE times the expected powers of noise and residual echo are subtracted, so what remains is surely neither.
    """
    error = frame.error
    power = fourier.power(error)
    least = power - np.float32(SURE) * (frame.noise_psd + frame.residual_psd)
    with np.errstate(over="ignore"):  # of a network that has grown beyond all bounds
        short = least > fourier.power(sounds)
    sure = np.sqrt(np.maximum(least, 0.0) / (power + fourier.TINY)) * error
    return np.where(short, sure, sounds)


def _power(spectrum: Spectrum) -> float:
    return float(np.vdot(spectrum, spectrum).real)


def _limited(found: float, most: float) -> np.float32 | None:
    """The gain that turns the power found down to most, 1 where it is below; None where it is no number."""
    if found <= most:
        return np.float32(1.0)
    return np.float32(math.sqrt(most / found)) if math.isfinite(found) else None
