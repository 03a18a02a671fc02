"""`edgefilter doctor`: whether this machine is fit for a live run, and what to do where it is not."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from edgefilter.alignment.lag_search import MOST_LAG_S
from edgefilter.audio import pulse, virtual
from edgefilter.audio.channels import Channels
from edgefilter.audio.device import find, input_port, monitor_of
from edgefilter.audio.live import LiveSource
from edgefilter.audio.measure import Channel, Trial, listen, play_through
from edgefilter.audio.port import InputPort
from edgefilter.calibration.calibrate import FARTHEST
from edgefilter.calibration.chirps import LEVEL_DB, SOFTER_DB, Heard, chirps, evaluate
from edgefilter.commands.display import print_result, say
from edgefilter.diagnosis.channels import doubtful_channels
from edgefilter.diagnosis.passport import ENOUGH_DB
from edgefilter.engines import create
from edgefilter.errors import EdgefilterError
from edgefilter.filter.budget import DEFAULT_MS, allowed_cores
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.microphones import APART_DB, CLIPPED_DB
from edgefilter.profile.data import Profile
from edgefilter.session import SILENT_DB
from edgefilter.types import SAMPLE_RATE, Samples

PACE = 0.005
"""Error of a device's clock that passes: 3 s of listening tell no less, though the filter follows only far smaller ones."""
TOO_SOFT_DB = -75.0
"""Level, dB of full scale, under which the gain is too low: the noise of 16 bit, -101 dB, is 26 dB below."""
SAME, UNLIKE = 0.999, 0.2
"""Coherence of a copy, and that below which a channel is no microphone of the array: the array of a real robot has .7 to
.99 up to 4 kHz in its own noise, a microphone of another kind beside it .1."""
CHANGED_DB = 1.5
"""Difference of two gains, dB, that neither noise nor a small loudspeaker explains: they differ by some tenths."""


@dataclass(frozen=True)
class Check:
    """One finding. do: what helps, empty where nothing is needed."""

    name: str
    state: Literal["ok", "warning", "failed"]
    found: str
    do: str = ""


def checked(name: str, found: str, do: str = "") -> Check:
    """A finding that is well where nothing is to be done."""
    return Check(name, "warning" if do else "ok", found, do)


def main(args: argparse.Namespace) -> int:
    checks = []
    profile = Profile.load(args.profile) if args.profile else None
    speaker = None if args.no_chirp else args.speaker
    for check in examine(args.input, args.reference, speaker, args.mic_channels, profile):
        checks.append(check)
        print_result(args, [f"{check.state:8} {check.name:13} {check.found}" + (f": {check.do}" if check.do else "")])
    failed = [check.name for check in checks if check.state == "failed"]
    verdict = f"not fit for a live run: {', '.join(failed)} failed" if failed else "fit for a live run"
    print_result(args, [verdict], {"schema": 1, "fit": not failed, "checks": [asdict(check) for check in checks]})
    return 1 if failed else 0


def examine(
    microphone: str,
    reference: str | None,
    speaker: str | None,
    channels: Channels | None = None,
    profile: Profile | None = None,
) -> Iterator[Check]:
    """All checks, each as soon as it is done. speaker: what plays the chirps; None for none of them.

    channels: of the microphone's device, where it is an array. profile: of as many microphones, to hold them against.
    """
    cores = len(allowed_cores())
    few = "loudspeaker and room are not learned while running; allow another core"
    yield checked("cores", str(cores), few if cores < 2 else "")
    yield from _guarded("model", _model())
    yield from _guarded("engine", _engine())
    yield from _guarded("sound server", _server())
    ports: dict[str, InputPort] = {}
    yield from _guarded("microphone", _open(ports, "microphone", microphone, channels))
    yield from _guarded("reference", _open(ports, "reference", reference))
    if ports:
        yield from _guarded("sound", _sound(ports))
    if speaker is not None and len(ports) == 2:
        yield from _guarded("set-up", _set_up(ports, speaker, channels, profile))


def _guarded(name: str, checks: Iterator[Check]) -> Iterator[Check]:
    """The checks of one subject; an EdgefilterError is a check that failed, and says itself what to do."""
    try:
        yield from checks
    except EdgefilterError as error:
        yield Check(name, "failed", " ".join(str(error).split()))


def _model() -> Iterator[Check]:
    model = getattr(create("crnn"), "model", None)
    if model is None:
        return
    found, do = "as shipped", ""
    if not model.shipped:
        found, do = "not the one of this package", "unset EDGEFILTER_CRNN unless you set it on purpose"
    yield checked("model", f"{model.path}, sha256 {model.sha256[:12]}, {found}", do)


def _engine() -> Iterator[Check]:
    ego = EgoFilter()
    noise = 0.1 * np.random.default_rng(0).standard_normal(SAMPLE_RATE).astype(np.float32)
    took = []
    for at in range(0, noise.size, ego.hop):
        began = time.perf_counter()
        ego.process(noise[at : at + ego.hop], noise[at : at + ego.hop])
        took.append(1000 * (time.perf_counter() - began))
    typical = float(np.median(took))
    found = f"{ego.engine_name}, {typical:.1f} ms of computing for a hop of {1000 * ego.hop / SAMPLE_RATE:.0f} ms"
    slow = "'run --engine auto' will take a cheaper one; end other programs"
    yield checked("engine", found, slow if typical > DEFAULT_MS else "")


def _server() -> Iterator[Check]:
    outputs = pulse.names("output")
    if not outputs:
        help_with = "start PulseAudio or PipeWire (and install pulseaudio-utils), or name an input that records the loudspeaker with --reference"
        yield checked("sound server", "none answers", help_with)
        return
    yield checked("sound server", f"{len(outputs)} outputs, default {pulse.default_name('output') or 'none'}")
    made = virtual.SPEAKER in outputs and virtual.HUMAN in outputs
    yield checked("virtual mic", "there" if made else "not made ('edgefilter devices --load' makes it)")


def _open(
    ports: dict[str, InputPort], role: str, name: str | None, channels: Channels | None = None
) -> Iterator[Check]:
    """Find the input and see at which rate it can be opened."""
    device = find(name if name is not None else pulse.monitor(virtual.SPEAKER) or monitor_of("default"), "input")
    if role == "microphone":
        virtual.refuse_own(device)
    port = input_port(device, channels=channels)
    ports[role] = port
    yield checked(role, ", ".join([f"{port.device}, {port.rate} Hz", *port.notes]))


def _sound(ports: dict[str, InputPort]) -> Iterator[Check]:
    for (role, _), trial in zip(ports.items(), listen(list(ports.values()))):
        yield _clock(role, trial)
        if role == "microphone":
            yield _level(trial)
            yield from array_checks(trial.channels)
        if trial.overruns:
            yield checked(f"{role} load", f"{trial.overruns} overruns in 3 s", "end other programs")


def array_checks(channels: Sequence[Channel]) -> Iterator[Check]:
    """A check for each microphone of an array, beside the others."""
    level = float(np.median([one.level_db for one in channels])) if channels else 0.0
    silent = [one.peak_db <= SILENT_DB for one in channels]
    first = silent.index(False) if False in silent else 0
    for at, one in enumerate(channels):
        found = f"{one.level_db:.0f} dB, floor {one.floor_db:.0f} dB, peak {one.peak_db:.0f} dB"
        found += f", coherence {one.coherence:.2f} with channel {channels[first].number}" if at > first else ""
        why = ""
        if silent[at]:
            why = "it is silent"
        elif one.peak_db > CLIPPED_DB:
            why = "it is clipped (or lower its gain)"
        elif abs(one.level_db - level) > APART_DB:
            why = "it is of another kind, or has another gain"
        elif at > first and one.coherence > SAME:
            why = f"it is a copy of channel {channels[first].number}"
        elif at > first and one.coherence < UNLIKE:
            why = f"it has nothing in common with channel {channels[first].number}: processed, or what is played?"
        yield checked(f"channel {one.number}", found, f"leave it out of --mic-channels: {why}" if why else "")


def _set_up(
    ports: dict[str, InputPort], speaker: str, channels: Channels | None, profile: Profile | None
) -> Iterator[Check]:
    """Play chirps and hear them as a run would, of an array in the first microphone; then hold the others beside it."""
    microphone, reference = ports["microphone"], ports["reference"]
    if microphone.device == reference.device:
        found = f"microphone and reference are both '{microphone.device}'"
        yield Check("set-up", "failed", found, "name the real microphone with --input")
        return
    output = virtual.SPEAKER if speaker == "default" and pulse.monitor(virtual.SPEAKER) else speaker
    sound = chirps()
    say(
        f"chirps for {sound.size / SAMPLE_RATE:.0f} s on output '{output}', peak {LEVEL_DB:.0f} dB of full scale"
        " (--no-chirp: without)"
    )
    mic, ref, lost = play_through(output, LiveSource(microphone.device, reference.device, channels=channels), sound)
    each = mic.reshape(len(mic), -1).T
    yield from set_up_check(evaluate(each[0], ref), output, str(reference.device))
    yield from array_set_up(microphone.wanted or [0], each, ref, profile)
    if lost:
        yield checked("set-up load", f"{lost} samples lost while the chirps were heard", "end other programs")


def array_set_up(numbers: Sequence[int], mics: Samples, ref: Samples, profile: Profile | None) -> Iterator[Check]:
    """What the chirps have shown of the microphones mics (microphones, n) beside one another, and beside a profile."""
    heard = [evaluate(one, ref) for one in mics] if len(mics) > 1 else []
    lags = [one.lag_s for one in heard if one.lag_s is not None and not one.same]
    middle = float(np.median(lags)) if lags else 0.0
    told = set()
    for number, one in zip(numbers, heard):
        if one.same:
            told.add(number)
            yield checked(f"channel {number}", "it is what is played", "leave it out of --mic-channels")
        elif one.lag_s is not None and abs(late := one.lag_s - middle) > FARTHEST / SAMPLE_RATE:
            told.add(number)
            found = f"it hears the chirps {1000 * late:+.0f} ms beside the others"
            yield checked(f"channel {number}", found, "leave it out of --mic-channels: it is processed")
    if profile is None or not all(one.in_microphone for one in heard):
        return
    doubts = doubtful_channels(profile, mics, ref)
    for at, what in doubts.items():
        if numbers[at] not in told:
            do = "put --mic-channels into the order in which they were calibrated, mend it, or calibrate again"
            yield checked(f"channel {numbers[at]}", what, do)
    if not doubts:
        yield checked("profile", f"{profile.microphones} microphones as they were calibrated")


def set_up_check(heard: Heard, output: str, reference: str) -> Iterator[Check]:
    """What the chirps have shown: whether the reference is right, then what the microphone makes of the robot."""
    if wrong := _wrong(heard, output, reference):
        yield wrong
        return
    assert heard.lag_s is not None and heard.above_noise_db is not None and heard.ppm is not None
    assert heard.linear_db is not None and heard.softer_db is not None
    found = (
        f"the microphone hears the robot after {1000 * heard.lag_s:.0f} ms, {heard.above_noise_db:.0f} dB above the noise,"
        f" clocks {abs(heard.ppm):.0f} ppm apart; linear echo {heard.linear_db:.0f} dB"
    )
    if heard.linear_db >= ENOUGH_DB or heard.linear_db > heard.above_noise_db - 6.0:
        yield checked("set-up", f"{found}: good")
    else:
        do = "turn the loudspeaker down, and end other programs: distortion and unsteady clocks are not predicted"
        yield checked("set-up", found, do)
    # what changes the sound on its way: a converter at its end, gain control, noise suppression
    softer = f"chirps {SOFTER_DB:.0f} dB softer come {abs(heard.softer_db):.1f} dB"
    if heard.peak_db > CLIPPED_DB:
        yield checked("set-up", "the chirps are clipped at the microphone", "lower its gain or the loudspeaker")
    elif heard.softer_db > CHANGED_DB:
        do = "switch gain control off in device or sound server, or turn down the loudspeaker"
        yield checked("set-up", f"{softer} louder than they should", do)
    elif heard.softer_db < -CHANGED_DB:
        do = "switch noise suppression and echo cancelling off in device or sound server"
        yield checked("set-up", f"{softer} softer than they should", do)


def _wrong(heard: Heard, output: str, reference: str) -> Check | None:
    """What keeps a run from hearing the robot as it should; None where nothing does."""
    if heard.in_reference and not heard.in_microphone:
        found = f"the reference has the chirps, the microphone does not hear them (its peak: {heard.peak_db:.0f} dB)"
        return checked("set-up", found, "unmute loudspeaker and microphone, turn them up, or name others")
    if not heard.in_reference:
        found = f"reference '{reference}' is silent while something is played on output '{output}'"
        do = f"take the monitor of '{output}' (--reference), or play elsewhere (--speaker)"
    elif heard.same:
        found = "the microphone is a copy of the reference, not a microphone"
        do = "name the real one with --input ('edgefilter devices')"
    elif heard.lag_s is not None and heard.lag_s < -0.001:
        found = f"the reference comes {-1000 * heard.lag_s:.0f} ms after the microphone has heard it"
        do = "take a reference with less buffering, such as the output's own monitor"
    elif heard.lag_s is not None and heard.lag_s > MOST_LAG_S:
        late = f"{heard.lag_s:.2f} s, more than the {MOST_LAG_S} s that are searched"
        found = f"the microphone hears the robot after {late}"
        do = "use a loudspeaker or a microphone with less delay"
    else:
        return None
    return Check("set-up", "failed", found, do)


def _clock(role: str, trial: Trial) -> Check:
    name = f"{role[:3]} clock"
    found = f"{100 * (trial.pace - 1):+.2f} % of {trial.rate} Hz (to some 0.1 %)"
    if abs(trial.pace - 1) <= PACE:
        return checked(name, found)
    do = f"the {role} loses samples or runs at another rate: end other programs, try another"
    return Check(name, "failed", found, do)


def _level(trial: Trial) -> Check:
    found, do = f"{trial.level_db:.0f} dB of full scale, peak {trial.peak_db:.0f} dB", ""
    if trial.peak_db <= SILENT_DB:
        found, do = "every sample is zero", "unmute the microphone, or name another with --input"
    elif trial.level_db < TOO_SOFT_DB:
        do = "raise the microphone's gain"
    elif trial.peak_db > CLIPPED_DB:
        do = "lower the microphone's gain: it is clipped"
    return checked("level", found, do)
