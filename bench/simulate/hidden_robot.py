"""A simulated robot before and after: its room, and what its microphone records while it speaks, with or without a change.

Shares no code with the filter's own echo model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pyroomacoustics as pra
from scipy import signal

from bench.simulate import simulated_robot as physics
from bench.simulate.simulated_robot import RATE, SOUND_M_S, Array, Loudspeaker, Rng

PHASES = 4096
HALF_WIDTH = 32


@dataclass(frozen=True)
class Place:
    """A robot in a room: size (3,) in m, wall absorption, highest order of reflection, microphone, loudspeaker (3,)."""

    size: Array
    absorption: float
    order: int
    microphone: Array
    loudspeaker: Array

    def response(self) -> Array:
        """Impulse response by image sources, (m,) (Allen & Berkley 1979; pyroomacoustics), without its filter delay."""
        room = pra.ShoeBox(self.size, fs=RATE, materials=pra.Material(self.absorption), max_order=self.order)
        room.add_microphone(self.microphone)
        room.add_source(self.loudspeaker)
        room.compute_rir()
        return np.asarray(room.rir[0][0][pra.constants.get("frac_delay_length") // 2 :], np.float64)

    def microphone_moved(self, step: Array) -> Place:
        return replace(self, microphone=self.microphone + step)

    def robot_moved(self, step: Array) -> Place:
        """Loudspeaker and microphone moved together, kept 0.2 m from the walls."""
        inside = [np.clip(point + step, 0.2, self.size - 0.2) - point for point in (self.microphone, self.loudspeaker)]
        allowed = np.where(np.abs(inside[0]) < np.abs(inside[1]), *inside)
        return replace(self, microphone=self.microphone + allowed, loudspeaker=self.loudspeaker + allowed)


def draw_place(rng: Rng, rt60_s: float, geometry: Array | None = None, size: Array | None = None) -> Place:
    """A room of about this reverberation time: by Sabine's formula, which is off by up to 25 %.

    geometry (3,): from microphone to loudspeaker in m, else drawn, 0.1-0.3 m. size (3,) in m, else drawn.
    """
    if size is None:
        size = np.array([rng.uniform(3.8, 7.5), rng.uniform(3.2, 5.5), rng.uniform(2.5, 3.2)])
    if geometry is None:
        direction = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(-0.8, -0.1)])
        geometry = rng.uniform(0.1, 0.3) * direction / np.linalg.norm(direction)
    absorption, order = pra.inverse_sabine(rt60_s, size)
    microphone = np.array([*rng.uniform(0.9, size[:2] - 0.9), rng.uniform(0.8, 1.3)])
    return Place(size, absorption, min(order, 50), microphone, microphone + geometry)


def direction(rng: Rng) -> Array:
    """A random direction of length 1, (3,)."""
    x = rng.standard_normal(3)
    return x / np.linalg.norm(x)


def reflector(rng: Rng, place: Place) -> Callable[[float], Array]:
    """Impulse response (m,) of one reflection (image source, low-pass of first order) at a given distance in m."""
    towards, loss, corner = direction(rng), rng.uniform(0.5, 0.9), rng.uniform(2500, 7000)
    towards[2] *= 0.2
    towards /= np.linalg.norm(towards)
    b, a = signal.butter(1, corner, fs=RATE)

    def at(distance_m: float) -> Array:
        offset = place.loudspeaker - place.microphone
        image = offset + 2 * max(distance_m - offset @ towards, 0.02) * towards
        length = float(np.linalg.norm(image))
        impulse = fractional_delay(np.eye(1, 4096)[0], length / SOUND_M_S * RATE)
        return signal.lfilter(b, a, loss / (4 * math.pi * length) * impulse)

    return at


@functools.cache
def _sinc_table() -> Array:
    """Kaiser-windowed sincs (beta 9), row p for a position p / PHASES behind a sample, (PHASES + 1, 2 HALF_WIDTH)."""
    distance = np.arange(-HALF_WIDTH + 1, HALF_WIDTH + 1)[None] - np.arange(PHASES + 1)[:, None] / PHASES
    return np.sinc(distance) * np.i0(9.0 * np.sqrt(np.clip(1.0 - (distance / HALF_WIDTH) ** 2, 0.0, 1.0))) / np.i0(9.0)


def read_at(x: Array, positions: Array) -> Array:
    """Samples x (n,) at positions (m,), rounded to 1/4096 of a sample (error below -74 dB at 4 kHz), 0 outside."""
    table = _sinc_table()
    padded = np.pad(x, 2 * HALF_WIDTH)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WIDTH)
    whole = np.floor(positions).astype(int)
    phase = np.rint((positions - whole) * PHASES).astype(int)
    first = np.clip(whole + HALF_WIDTH + 1, 0, windows.shape[0] - 1)
    out = np.empty(positions.size)
    for start in range(0, positions.size, 1 << 13):
        part = slice(start, start + (1 << 13))
        out[part] = np.einsum("ij,ij->i", windows[first[part]], table[phase[part]])
    return out


def fractional_delay(x: Array, samples: float) -> Array:
    """Samples x (n,) later by any number of samples >= 0, of the same length."""
    whole = int(np.floor(samples))
    taps = read_at(np.eye(1, 4 * HALF_WIDTH, 2 * HALF_WIDTH)[0], np.arange(4 * HALF_WIDTH) - (samples - whole))
    late = signal.oaconvolve(x, taps)[2 * HALF_WIDTH :][: x.size]
    return np.concatenate([np.zeros(whole), late])[: x.size]


def sweep(rng: Rng) -> Array:
    """Exponential sweep, 40 to 8000 Hz (Farina 2000, eq. (2)), 5-8 s, peak 0.25-0.45, between silence."""
    seconds, peak = rng.uniform(5, 8), rng.uniform(0.25, 0.45)
    n = int(seconds * RATE)
    rate = math.log(8000 / 40)
    x = peak * np.sin(2 * math.pi * 40 * seconds / rate * (np.exp(np.arange(n) / n * rate) - 1.0))
    fade = np.sin(0.5 * math.pi * np.arange(320) / 320) ** 2
    x[:320] *= fade
    x[-320:] *= fade[::-1]
    return np.concatenate([np.zeros(RATE // 2), x, np.zeros(RATE)])


def power(x: Array) -> float:
    return float(np.mean(np.square(x)))


def decibels(ratio: float) -> float:
    return 10 * math.log10(max(ratio, 1e-12))


def solve(measure: Callable[[float], float], target: float, low: float, high: float, tolerance: float = 0.15) -> float:
    """The x in [low, high] (both > 0) where the monotonic measure is target, by bisection of log x; else an end."""
    rising = measure(high) > measure(low)
    a, b = math.log(low), math.log(high)
    for _ in range(14):
        middle = 0.5 * (a + b)
        found = measure(math.exp(middle))
        if abs(found - target) < tolerance:
            break
        a, b = (middle, b) if (found < target) == rising else (a, middle)
    return math.exp(middle)


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

    moved: where it stands after the calibration. reference (n,). delay: of the converters in the sweep, samples;
    offset: what is added to it in the recording. gain_after: from the room's pressure to full scale, with its
    tolerance. fan_power: of the calibrated noise. fan_amplitude (1025,): its spectrum on 0-8000 Hz, unit power.
    """

    moved: Place
    shell: Array
    reference: Array
    delay: float
    offset: float
    gain_after: float
    fan_power: float
    fan_amplitude: Array
    signals: dict[str, Array]
    usual: Chain
    tolerances: dict[str, float]
    _pressure: list[tuple[Array, Loudspeaker, Array]] = field(default_factory=list)

    def pressure(self, chain: Chain) -> Array:
        """The signal in front of the loudspeaker, (n,); the last three are kept."""
        for played, loudspeaker, found in self._pressure:
            if played is chain.played and loudspeaker is chain.loudspeaker:
                return found
        found = chain.loudspeaker.play(chain.played)
        self._pressure = [*self._pressure[-2:], (chain.played, chain.loudspeaker, found)]
        return found

    def echo(self, chain: Chain) -> Array:
        """The robot at the microphone, (n,)."""
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
        """The microphone's recording, (n,)."""
        mic = self.echo(chain) + chain.fan
        mic = mic if chain.others is None else mic + chain.others
        for stage in chain.microphone:
            mic = stage(mic)
        return mic

    def over_fan_db(self, difference: Array) -> float:
        return decibels(power(difference) / self.fan_power)

    def linear_response(self) -> Array:
        """Impulse response from what is played to the microphone at small signals, (m,), 256 samples late for the converters' delay."""
        impulse = np.eye(1, 2048, 256)[0]
        path = signal.oaconvolve(self.usual.paths[0][2], self.shell)
        return self.gain_after * signal.oaconvolve(self.usual.loudspeaker.play(impulse, linear=True), path)


def _gate(n: int, start: int, fade: int) -> Array:
    return np.clip((np.arange(n) - start) / max(fade, 1), 0.0, 1.0)


def draw_scene(rng: Rng, reference: Array, robot_over_fan_db: float) -> Scene:
    """A robot, its calibration, and another day with the ordinary tolerances.

    robot_over_fan_db: of the whole recording. Tolerances: offset -60..60 samples, fan +-0.4 dB, gain +-0.1 dB, the
    microphone moved by 0.1-0.9 mm, distortion of FAINT_DB over the fan. All recordings together are scaled later, see
    `hidden_cases.scale`.
    """
    place, shell = draw_place(rng, rng.uniform(0.18, 0.32)), draw_shell(rng)
    turning, hiss = physics.draw_fan(rng), 10 ** (-rng.uniform(6, 13) / 10)  # the hiss of the air's flow is flat
    amplitude = np.sqrt((turning**2 + hiss) / (1 + hiss))
    move_m = rng.uniform(1e-4, 9e-4)
    moved = place.microphone_moved(move_m * direction(rng))
    offset = rng.uniform(-60, 60)
    tolerances = {"offset_samples": offset, "fan_db": rng.uniform(-0.4, 0.4), "gain_db": rng.uniform(-0.1, 0.1)}
    tolerances["move_mm"] = 1e3 * move_m
    excitation, delay = sweep(rng), rng.uniform(140, 700)
    paths = [signal.oaconvolve(p.response(), shell) for p in (place, moved)]
    straight = physics.draw_loudspeaker(rng)
    whole = signal.oaconvolve(straight.play(np.eye(1, 2048, 256)[0], linear=True), paths[0])
    echo = signal.oaconvolve(reference, whole)[: reference.size]
    peak = np.abs(signal.oaconvolve(excitation, whole)).max()
    gain = rng.uniform(0.25, 0.5) / peak
    fan_power = gain**2 * power(echo) * 10 ** (-robot_over_fan_db / 10)
    wanted = fan_power / gain**2 * 10 ** (rng.uniform(*FAINT_DB) / 10)
    loudspeaker, distortion = with_distortion(straight, reference, paths[0], wanted)
    tolerances["distortion_over_fan_db"] = decibels(distortion * gain**2 / fan_power)
    swept = gain * fractional_delay(signal.oaconvolve(loudspeaker.play(excitation), paths[0])[: excitation.size], delay)
    sizes = excitation.size, 8 * RATE, reference.size
    noises = [math.sqrt(fan_power) * physics.fan_noise(rng, amplitude, n) for n in sizes]
    signals = {"sweep_ref": excitation, "sweep_mic": swept + noises[0], "fan_only": noises[1], "ref": reference}
    usual = Chain(reference, loudspeaker, ((0, 0, moved.response()),), noises[2] * 10 ** (tolerances["fan_db"] / 20))
    gain_after = gain * 10 ** (tolerances["gain_db"] / 20)
    return Scene(moved, shell, reference, delay, offset, gain_after, fan_power, amplitude, signals, usual, tolerances)


def draw_shell(rng: Rng) -> Array:
    """Impulse response of the robot's body, (128,): reflections within 2 ms, and 4-10 dB less treble."""
    turn, loss_db = rng.uniform(1200, 3000), rng.uniform(4, 10)
    low = 10 ** (-loss_db / 20)
    b, a = signal.bilinear([low, 2 * math.pi * turn], [1.0, 2 * math.pi * turn], RATE)
    return signal.lfilter(b, a, np.pad(physics.draw_body(rng), (0, 96)))


def with_distortion(loudspeaker: Loudspeaker, played: Array, path: Array, wanted: float) -> tuple[Loudspeaker, float]:
    """The driver turned until what its nonlinearity adds behind this path in 5 s has the wanted power; that power."""
    x = played[RATE : 6 * RATE]
    straight = loudspeaker.play(x, linear=True)

    def added(drive: float) -> float:
        return power(signal.oaconvolve(replace(loudspeaker, drive=drive).play(x) - straight, path)[: x.size])

    drive = 0.3
    for _ in range(2):
        drive = float(np.clip(drive * (wanted / added(drive)) ** 0.45, 1e-2, 30.0))
    return replace(loudspeaker, drive=drive), added(drive)
