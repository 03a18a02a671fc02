"""A device's passport in words: lines for the terminal, rows and sentences for the page and JSON."""

from __future__ import annotations

from dataclasses import dataclass

from edgefilter.diagnosis.passport import Passport
from edgefilter.report.text import sentence
from edgefilter.types import expect_positive

ERROR_DB = 2.3, 8.4
"""Of the predicted SI-SDR, median and worst of 34 humans on 7 real devices, three engines: bench/results/passport.md."""


@dataclass(frozen=True)
class SetUp:
    """A set-up of which nothing is said; raises UsageError for a difference that is not above 0."""

    drift_ppm: float = 50.0
    """Clocks further apart than this share no crystal: those of one sound card agree to 1 ppm, two cheap ones to 100."""
    lag_spread_ms: float = 2.0
    """A lag that moves more than this within a recording is no room's: buffers run empty or are filled up."""
    quiet_db: float = -50.0
    """A microphone whose peaks stay under this uses 7 of its 16 bits."""
    unlearned_db: float = 6.0
    """Where a fixed filter can remove so much more than the running one did, calibrating or learning pays."""

    def __post_init__(self) -> None:
        expect_positive({name: getattr(self, name) for name in ("drift_ppm", "lag_spread_ms", "unlearned_db")})


SET_UP = SetUp()
CAUSES = {
    "nothing": "nothing stands in the way of a linear filter",
    "noise": "the noise is what a linear filter leaves",
    "gate": "the microphone falls silent while the robot talks: it is processed (a gate, noise suppression)",
    "clipping": "the microphone is overdriven: its loudest samples are cut off",
    "change": "the loudspeaker distorts, or the microphone is processed (gain control, noise suppression): its levels follow the"
    " reference, its waveform does not",
    "other": "something else sounds that does not follow the reference: somebody talks, or there is another source",
}
FIRST = {
    "noise": "make the room or the fan quieter, or bring the human nearer to the microphone",
    "gate": "switch off the microphone's noise suppression, gain control and echo cancellation, then record again",
    "clipping": "turn the microphone's gain down by 6 to 12 dB, then record again",
    "change": "switch off the microphone's processing; if there is none, turn the loudspeaker down by 6 dB, and record again",
    "other": "record the robot alone, without people, radio or a second loudspeaker",
}


def headline(found: Passport) -> str:
    """The most important in a sentence."""
    if not found.engines:
        return "The reference is found."
    best = max(found.engines, key=lambda name: found.engines[name].si_sdr_db)
    return f"Expect an SI-SDR of {found.engines[best].si_sdr_db:.0f} dB with {best}, for a human {_against(found.human_db)}."


def expectation(found: Passport) -> dict[str, object]:
    """What was found, how uncertain the prediction is, and what to change first, for JSON."""
    return {
        "headline": headline(found),
        "cause": sentence(CAUSES[found.cause]),
        "changes": advice(found),
        "uncertainty_db": {"median": ERROR_DB[0], "worst": ERROR_DB[1]},
    }


def advice(found: Passport) -> list[str]:
    """What to change, the most important first."""
    told = [FIRST[found.cause]] if found.cause in FIRST else []
    if not found.pauses:
        told += ["let the robot pause for some seconds while it is recorded: the noise is not known, and may be less"]
    if found.mic_peak_db < SET_UP.quiet_db:
        told.append(f"turn the microphone's gain up: its peaks reach only {found.mic_peak_db:.0f} dBFS")
    if found.lost_ms:
        told.append(
            f"use a loopback that loses no samples, or larger buffers: {found.lost_ms:.0f} ms are missing in the reference"
        )
    elif found.lag_spread_ms > SET_UP.lag_spread_ms:
        told.append(
            "the delay of the robot at the microphone jumps: use larger buffers, or play and record in one program"
        )
    if abs(found.drift_ppm) > SET_UP.drift_ppm:
        told.append("use one sound card for loudspeaker and microphone, if you can: the clocks drift apart")
    linear = found.engines.get("linear")
    if linear and found.removable_db - linear.removed_db > SET_UP.unlearned_db:
        told.append(
            "the filter had not yet learned all of the echo path: calibrate, or let it learn for longer (`run --learn`)"
        )
    return [sentence(one) for one in told or ["nothing needs to be changed"]]


def rows(found: Passport) -> list[tuple[str, str, str]]:
    """Name, value and what it means, of everything that is one number."""
    noise = f"{found.noise_db:.0f} dBFS" if found.noise_db > -119.0 else "none"
    moves = f"moves by {found.lag_spread_ms:.1f} ms; certain in {100 * found.sharp:.0f} % of the seconds"
    return [
        ("microphone", f"{found.mic_db:.0f} dBFS", f"peak {found.mic_peak_db:.0f} dBFS"),
        ("reference", f"{found.ref_db:.0f} dBFS", f"peak {found.ref_peak_db:.0f} dBFS"),
        ("noise", noise, "in the robot's pauses" if found.pauses else "at most: in the quietest moments"),
        ("lag", f"{found.lag_ms:.0f} ms", moves),
        ("drift", f"{found.drift_ppm:+.0f} ppm", "positive: the lag shrinks"),
        ("linear", f"{found.removable_db:.1f} dB", "what a fixed linear filter can take off, by coherence"),
        ("over noise", f"{found.over_noise_db:.1f} dB", "microphone over its noise"),
        ("changed", f"{found.change_db:.0f} dB", "distortion, relative to the linear part of the echo"),
        ("follows", f"{found.follows:.2f}", "correlation of band levels with the reference's"),
        ("gated", f"{100 * found.gated:.0f} %", "of the time the microphone is digitally silent while the robot plays"),
    ]


def lines(found: Passport, diagnosis: str) -> list[str]:
    """For the terminal."""
    told = [headline(found), ""]
    told += [f"{name:<12}{value:<10}{what}" for name, value, what in rows(found)]
    told += [f"{'':<12}{sentence(CAUSES[found.cause])}", ""]
    heads = ("linear", "noise", "follows", *found.engines)
    told.append(f"{'band, Hz':<12}" + "".join(f"{head:>10}" for head in heads))
    for band in found.bands:
        row = f"{f'{band.low:.0f}-{band.high:.0f}':<12}{band.removable_db:>10.1f}{band.over_noise_db:>10.1f}"
        engines = "".join(f"{band.removed_db[name]:>10.1f}" for name in found.engines)
        told.append(f"{row}{band.follows:>10.2f}{engines}")
    told += ["", *(f"{name:<12}{what}" for name, what in engine_lines(found)), f"{'':<12}{uncertainty(found)}"]
    told += ["", f"{'diagnosis':<12}{diagnosis}"]
    return [*told, "change first:", *(f"  {at}. {line}" for at, line in enumerate(advice(found), start=1))]


def engine_lines(found: Passport) -> list[tuple[str, str]]:
    """What is expected of each engine."""
    told = []
    for name, one in found.engines.items():
        starts = "" if one.false_starts is None else f", {one.false_starts} false starts of speech"
        human = f"a human {_against(found.human_db)}: SI-SDR {one.si_sdr_before_db:.1f} -> {one.si_sdr_db:.1f} dB"
        told.append((name, f"robot alone lowered by {one.removed_db:.1f} dB{starts}; {human}"))
    return told


def uncertainty(found: Passport) -> str:
    """Of the prediction, in a sentence or two."""
    median, worst = ERROR_DB
    told = f"On seven real devices other humans' SI-SDR differed from such a prediction by {median} dB at the median, {worst} dB at worst."
    if found.cause in ("gate", "change"):
        told += " What processes the microphone has not heard this human: expect less where it acts on speech."
    return told


def _against(human_db: float) -> str:
    if human_db == 0.0:
        return "as loud as the robot"
    return f"{abs(human_db):g} dB {'below' if human_db < 0.0 else 'above'} the robot"
