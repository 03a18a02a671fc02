"""One sentence for each finding: what in the recording speaks for it; and what is left, in words."""

from __future__ import annotations

import numpy as np

from edgefilter.diagnosis.leftover import Leftover
from edgefilter.diagnosis.prepare import Prepared
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effect import Values
from edgefilter.types import SAMPLE_RATE


def sentence(step: Trial) -> str:
    """What in the data speaks for the effect, with its figures."""
    maker = _SENTENCES.get(step.name)
    if maker is None:
        return f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB"
    return maker(step.values)


def _number(values: Values, name: str) -> float:
    return float(np.ravel(values[name])[0])


def _late_reverb(v: Values) -> str:
    return (
        f"the recording goes on sounding after the calibrated response has died away: a reverberation of {_number(v, 'rt60_s'):.2f} s that holds "
        "from the first second to the last"
    )


def _chassis_resonance(v: Values) -> str:
    modes = [f"{hz:.0f} Hz with Q {q:.0f}" for hz, q in zip(np.atleast_1d(v["frequency_hz"]), np.atleast_1d(v["q"]), strict=True)]
    return f"the residual rings at {'one frequency' if len(modes) == 1 else 'two frequencies'}, {' and '.join(modes)}, whenever the voice excites it"


def _playback_gain(v: Values) -> str:
    return f"the voice is {abs(_number(v, 'gain_db')):.2f} dB {'louder' if _number(v, 'gain_db') > 0 else 'softer'} at all frequencies and levels alike"


def _bandlimit(v: Values) -> str:
    return f"what the recording has in common with the reference falls off above {_number(v, 'cutoff_hz'):.0f} Hz"


def _clock_drift(v: Values) -> str:
    return f"the lag grows along a line, by {abs(_number(v, 'ppm')):.1f} samples in a million"


def _delay_jump(v: Values) -> str:
    times, samples = np.atleast_1d(v["times_s"]), np.atleast_1d(v["samples"])
    steps = ", ".join(f"{n:+.1f} samples at {t:.2f} s" for t, n in zip(times, samples, strict=True))
    return f"the lag is constant but for steps: {steps}"


def _path_change(v: Values) -> str:
    return f"until {_number(v, 'time_s'):.2f} s the calibrated path holds, from then on another one"


def _compression(v: Values) -> str:
    return (
        f"the voice is turned down when it has been loud: above {_number(v, 'threshold_db'):.0f} dB by {_number(v, 'ratio'):.1f} to 1, "
        "while the fan is as loud as ever"
    )


def _mic_agc(v: Values) -> str:
    return "voice and fan rise and fall together with a slow gain"


def _speaker_nonlinearity(v: Values) -> str:
    return f"products of the reference with itself, {_number(v, 'level_db'):.0f} dB re the voice, are in the residual: no linear path makes them"


def _mic_clipping(v: Values) -> str:
    return f"the predicted peaks exceed {_number(v, 'level'):.3f} of full scale and the recorded ones do not"


def _rattle(v: Values) -> str:
    side = {1.0: "outward", -1.0: "inward"}.get(_number(v, "side"), "far")
    return (
        f"short bursts, {_number(v, 'rate_hz'):.0f} a second, follow the moments at which the membrane is driven {side}, and not the voice's level; "
        "what of them no waveform predicts is shown as irreducible"
    )


def _fan_noise(v: Values) -> str:
    return f"the noise is {_number(v, 'change_db'):+.1f} dB off the calibrated fan, with the robot's voice and without it"


_SENTENCES = {name[1:]: maker for name, maker in list(globals().items()) if name.startswith("_") and callable(maker) and name[1:] not in ("number",)}


def left_in_words(prepared: Prepared, found: Found, left: Leftover, remaining_db: float, floor_db: float) -> str:
    """What is in the residual that no finding explains; empty where it is the fan."""
    spans = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in prepared.human)
    talk = f"somebody talks at {spans}, left out of all figures" if spans else ""
    if remaining_db < floor_db:
        return talk
    words = [talk] if talk else []
    if left.mains_hz and left.tone_share > 0.3:
        words.append(f"tones at multiples of {left.mains_hz:.0f} Hz, also while the robot is silent")
    elif left.tone_share > 0.5:
        words.append("tones at " + ", ".join(f"{hz:.0f}" for hz in left.tones_hz[:4]) + " Hz")
    final = found.final
    active = final.active_db - max(left.quiet_mean_db if np.isfinite(left.quiet_mean_db) else 0.0, 0.0)
    if np.isfinite(left.quiet_db) and left.quiet_mean_db > 1.0 and not words:
        words.append("sound of its own while the robot is silent" + (", coming and going" if left.swing_db > 6.0 else ""))
    if active > 1.0:
        weights = 10 * np.log10(np.maximum(final.cells, 1e-3)).mean(axis=0)
        top = int(np.argmax(weights))
        words.append(f"a residual that follows the robot's voice, strongest around {_band(top, final.cells.shape[1])}")
        if "bandlimit" in dict(found.model.effects):
            words.append("a codec that cuts the band leaves such noise")
    if not words:
        words.append("a residual spread over the whole recording")
    return f"{remaining_db:.1f} dB over the noise floor that no effect of the catalogue explains: " + "; ".join(words)


def _band(index: int, count: int) -> str:
    edges = np.geomspace(4, 250, count + 1) * SAMPLE_RATE / 512
    return f"{edges[index]:.0f} to {edges[index + 1]:.0f} Hz"
