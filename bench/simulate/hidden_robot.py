"""A simulated robot before and after.

What its microphone records while it speaks, with the ordinary tolerances, with or without a change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import signal

from bench.simulate.hidden_acoustics import (
    Place,
    decibels,
    direction,
    draw_place,
    fractional_delay,
    power,
    read_at,
    sweep,
)
from bench.simulate.simulated_robot import RATE, Array, Loudspeaker, draw_body, draw_fan, draw_loudspeaker, fan_noise

FAINT_DB = (-16.0, -9.0)
"""Range of what the loudspeaker's ordinary nonlinearity adds at the microphone, over the fan noise."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Everything between the reference and the recording. Arrays are (n,) at 16 kHz, n the recording's length.

    played: what the converter plays. impacts: sound that loose parts add at the loudspeaker. paths: (start in samples,
    length of the fade in samples, impulse response of the room), the first from 0 on. ringing: impulse response added
    to the path by the chassis, or None. lag: by how many samples the voice comes later than usual, or None. fan: noise.
    others: other sounds at the microphone. microphone: what amplifier and converter do to the sum.
    """

    played: Array
    loudspeaker: Loudspeaker
    paths: tuple[tuple[int, int, Array], ...]
    fan: Array
    impacts: Array | None = None
    ringing: Array | None = None
    lag: Array | None = None
    others: Array | None = None
    microphone: tuple[Callable[[Array], Array], ...] = ()


@dataclass(eq=False)
class Scene:
    """One robot on one day: calibration, reference, tolerances; `usual` is the chain when nothing is hidden.

    reference (n,). delay: of the converters in the sweep, samples; offset: what is added to it in the recording. gain:
    from the room's pressure to full scale, gain_after: with its tolerance. fan_power: of the calibrated noise.
    fan_amplitude (1025,): its spectrum on 0-8000 Hz, unit power.
    """

    place: Place
    moved: Place
    shell: Array
    reference: Array
    delay: float
    offset: float
    gain: float
    gain_after: float
    fan_power: float
    fan_amplitude: Array
    signals: dict[str, Array]
    usual: Chain
    tolerances: dict[str, float]
    _pressure: list[tuple[Array, Loudspeaker, Array]] = field(default_factory=list)

    def pressure(self, chain: Chain) -> Array:
        """(n,) in front of the loudspeaker; the last three are kept."""
        for played, loudspeaker, found in self._pressure:
            if played is chain.played and loudspeaker is chain.loudspeaker:
                return found
        found = chain.loudspeaker.play(chain.played)
        self._pressure = [*self._pressure[-2:], (chain.played, chain.loudspeaker, found)]
        return found

    def echo(self, chain: Chain) -> Array:
        """(n,) the robot at the microphone."""
        source = self.pressure(chain) if chain.impacts is None else self.pressure(chain) + chain.impacts
        heard = np.zeros(source.size)
        for i, (start, fade, response) in enumerate(chain.paths):
            whole = signal.oaconvolve(response, self.shell)
            if chain.ringing is not None:
                whole = signal.oaconvolve(whole, chain.ringing + np.eye(1, chain.ringing.size)[0])
            weight = _gate(source.size, start, fade) if i else np.ones(source.size)
            if i + 1 < len(chain.paths):
                weight = weight * (1.0 - _gate(source.size, *chain.paths[i + 1][:2]))
            heard += weight * signal.oaconvolve(source, whole)[: source.size]
        heard *= self.gain_after
        if chain.lag is None:
            return fractional_delay(heard, self.delay + self.offset)
        return read_at(heard, np.arange(source.size) - self.delay - self.offset - chain.lag)

    def record(self, chain: Chain) -> Array:
        """(n,) the microphone's recording."""
        mic = self.echo(chain) + chain.fan
        mic = mic if chain.others is None else mic + chain.others
        for stage in chain.microphone:
            mic = stage(mic)
        return mic

    def over_fan_db(self, difference: Array) -> float:
        return decibels(power(difference) / self.fan_power)

    def linear_response(self) -> Array:
        """(m,) from what is played to the microphone at small signals, 256 samples late for the converters' delay."""
        impulse = np.eye(1, 2048, 256)[0]
        path = signal.oaconvolve(self.usual.paths[0][2], self.shell)
        return self.gain_after * signal.oaconvolve(self.usual.loudspeaker.play(impulse, linear=True), path)


def _gate(n: int, start: int, fade: int) -> Array:
    return np.clip((np.arange(n) - start) / max(fade, 1), 0.0, 1.0)


def draw_scene(
    rng: np.random.Generator,
    reference: Array,
    robot_over_fan_db: float,
    faint_db: tuple[float, float] = FAINT_DB,
) -> Scene:
    """A robot, its calibration, and another day with the ordinary tolerances.

    robot_over_fan_db: of the whole recording. Tolerances: offset -60..60 samples, fan +-0.4 dB, gain +-0.1 dB, the
    microphone moved by 0.1-0.9 mm, distortion of faint_db over the fan. All recordings together are scaled later, see
    `hidden_cases.write_case`.
    """
    place, shell, amplitude = draw_place(rng, rng.uniform(0.18, 0.32)), draw_shell(rng), draw_hiss(rng)
    move_m = rng.uniform(1e-4, 9e-4)
    moved = place.microphone_moved(move_m * direction(rng))
    offset = rng.uniform(-60, 60)
    tolerances = {
        "offset_samples": offset,
        "fan_db": rng.uniform(-0.4, 0.4),
        "gain_db": rng.uniform(-0.1, 0.1),
        "move_mm": 1e3 * move_m,
    }
    excitation, delay = sweep(rng), rng.uniform(140, 700)
    paths = [signal.oaconvolve(p.response(), shell) for p in (place, moved)]
    straight = draw_loudspeaker(rng)
    whole = signal.oaconvolve(straight.play(np.eye(1, 2048, 256)[0], linear=True), paths[0])
    echo = signal.oaconvolve(reference, whole)[: reference.size]
    peak = np.abs(signal.oaconvolve(excitation, whole)).max()
    gain = rng.uniform(0.25, 0.5) / peak
    fan_power = gain**2 * power(echo) * 10 ** (-robot_over_fan_db / 10)
    wanted = fan_power / gain**2 * 10 ** (rng.uniform(*faint_db) / 10)
    loudspeaker, distortion = with_distortion(straight, reference, paths[0], wanted)
    tolerances["distortion_over_fan_db"] = decibels(distortion * gain**2 / fan_power)
    swept = gain * fractional_delay(signal.oaconvolve(loudspeaker.play(excitation), paths[0])[: excitation.size], delay)
    noises = [math.sqrt(fan_power) * fan_noise(rng, amplitude, n) for n in (excitation.size, 8 * RATE, reference.size)]
    signals = {"sweep_ref": excitation, "sweep_mic": swept + noises[0], "fan_only": noises[1], "ref": reference}
    usual = Chain(reference, loudspeaker, ((0, 0, moved.response()),), noises[2] * 10 ** (tolerances["fan_db"] / 20))
    gain_after = gain * 10 ** (tolerances["gain_db"] / 20)
    return Scene(
        place,
        moved,
        shell,
        reference,
        delay,
        offset,
        gain,
        gain_after,
        fan_power,
        amplitude,
        signals,
        usual,
        tolerances,
    )


def draw_shell(rng: np.random.Generator) -> Array:
    """(128,) what the robot's own body does.

    Reflections within 2 ms, and 4-10 dB less treble, as the microphone is not in front of the cone.
    """
    turn, loss_db = rng.uniform(1200, 3000), rng.uniform(4, 10)
    low = 10 ** (-loss_db / 20)
    b, a = signal.bilinear([low, 2 * math.pi * turn], [1.0, 2 * math.pi * turn], RATE)
    return signal.lfilter(b, a, np.pad(draw_body(rng), (0, 96)))


def draw_hiss(rng: np.random.Generator) -> Array:
    """(1025,) amplitude response of fan, air flow and microphone together on 0-8000 Hz, of unit power.

    The flow's hiss is 6-13 dB down and flat.
    """
    return np.sqrt((draw_fan(rng) ** 2 + (hiss := 10 ** (-rng.uniform(6, 13) / 10))) / (1 + hiss))


def with_distortion(loudspeaker: Loudspeaker, played: Array, path: Array, wanted: float) -> tuple[Loudspeaker, float]:
    """The driver turned until what its nonlinearity adds behind this path has the wanted power, and the power reached.

    Judged on 5 s.
    """
    x = played[RATE : 6 * RATE]
    straight = loudspeaker.play(x, linear=True)

    def added(drive: float) -> float:
        return power(signal.oaconvolve(replace(loudspeaker, drive=drive).play(x) - straight, path)[: x.size])

    drive = 0.3
    for _ in range(2):
        drive = float(np.clip(drive * (wanted / added(drive)) ** 0.45, 1e-2, 30.0))
    return replace(loudspeaker, drive=drive), added(drive)
