"""The physics of a simulated robot: loudspeaker, room, fan, converter clocks.

Shares no code with the filter's own echo model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pyroomacoustics as pra
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal, special

from edgefilter.dsp.metrics import si_sdr

RATE, SOUND_M_S = 16000, 343.0
OVERSAMPLING = 4
PIECE = 1 << 14
"""Samples that are worked on at once: they stay in a processor's cache."""
Array = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class Loudspeaker:
    """A small moving-coil driver in a closed box; nonlinear force factor and suspension, then linear filters.

    resonance_hz, q: of the linear driver. stiffening, softening_bl, asymmetry: bounded displacement laws, see `play`.
    drive: how far the signal's displacement reaches into them. filters: (sections, 6) of the enclosure and microphone,
    at 16 kHz.
    """

    resonance_hz: float
    q: float
    stiffening: float
    softening_bl: float
    asymmetry: float
    drive: float
    filters: Array

    def play(self, x: Array, linear: bool = False) -> Array:
        """Sound pressure in front of the driver (n,) for the voltage x (n,), both at 16 kHz.

        The equation of motion (Klippel 2006, "Loudspeaker nonlinearities", eq. (2) and (3), inductance left out)

            u'' + (w/Q) u' + w^2 u = w^2 [ b(u) x - s(u) u ] - (w/Q_e) [ b(u)^2 - 1 ] u'

        has the force factor b(u) = 1 - softening_bl v^2/(1 + v^2) - asymmetry v/(1 + v^2) and the excess stiffness s(u)
        = stiffening v^2/(1 + v^2), v = drive u; bounded, so that the iteration below converges. Half of the damping is
        electrical (1/Q_e = 0.5/Q). Solved at four times the rate (so that products of frequencies up to order 7 do not
        fold back into speech) by fixed-point iteration: the right side is recomputed from the last u, the left side is
        solved exactly by a bilinear filter. Pressure is the cone's acceleration. linear=True keeps b = 1, s = 0.
        """
        up = signal.resample_poly(x, OVERSAMPLING, 1)
        position, velocity, acceleration = self._mechanics()
        excess = np.zeros_like(up)
        memory = np.zeros((0 if linear else 6, 2, 2))  # of either filter in each round
        for at in range(0, up.size, PIECE):
            x, more = up[at : at + PIECE], excess[at : at + PIECE]
            for kept in memory:
                driven = x + more
                u, kept[0] = signal.lfilter(*position, driven, zi=kept[0])
                speed, kept[1] = signal.lfilter(*velocity, driven, zi=kept[1])
                v = self.drive * u
                bound = 1.0 / (1.0 + v * v)
                force = 1.0 - self.softening_bl * v * v * bound - self.asymmetry * v * bound
                braking = 0.5 / self.q * (force**2 - 1.0) * speed
                more = (force - 1.0) * x - self.stiffening * v * v * bound * u - braking
            excess[at : at + PIECE] = more
        pressure = signal.lfilter(*acceleration, up + excess)
        return signal.sosfilt(self.filters, signal.resample_poly(pressure, 1, OVERSAMPLING))

    def _mechanics(self) -> tuple[tuple[Array, Array], ...]:
        """Bilinear filters at the high rate for u, u'/w and u''/w^2 of w^2 / (s^2 + (w/Q) s + w^2)."""
        w = 2 * math.pi * self.resonance_hz
        denominator = [1.0, w / self.q, w * w]
        high_rate = RATE * OVERSAMPLING
        numerators = ([w * w], [w, 0.0], [1.0, 0.0, 0.0])
        return tuple(signal.bilinear(numerator, denominator, high_rate) for numerator in numerators)


def draw_loudspeaker(rng: Rng) -> Loudspeaker:
    """A driver of a small robot: resonance, treble roll-off, broad peaks of the enclosure, the microphone's low cut."""
    sections = [signal.butter(2, rng.uniform(6300, 7500), "low", fs=RATE, output="sos")]
    sections.append(signal.butter(2, rng.uniform(110, 210), "high", fs=RATE, output="sos"))
    for _ in range(4):
        hz = math.exp(rng.uniform(math.log(350), math.log(6000)))
        sections.append(peak_filter(hz, rng.uniform(1.0, 4.0), rng.uniform(-5, 5)))
    linear, laws = (rng.uniform(180, 320), rng.uniform(0.6, 1.0)), (rng.uniform(0.1, 0.3), rng.uniform(0.3, 0.5))
    asymmetry = rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 0.8)
    return Loudspeaker(*linear, *laws, asymmetry, 1.0, np.vstack(sections))


def peak_filter(frequency_hz: float, q: float, gain_db: float) -> Array:
    """Peaking section (Bristow-Johnson, "Audio EQ cookbook", peakingEQ), (1, 6)."""
    w, a = 2 * math.pi * frequency_hz / RATE, 10 ** (gain_db / 40)
    alpha = math.sin(w) / (2 * q)
    b = np.array([1 + alpha * a, -2 * math.cos(w), 1 - alpha * a])
    denominator = np.array([1 + alpha / a, -2 * math.cos(w), 1 - alpha / a])
    return np.concatenate([b, denominator])[None] / denominator[0]


@dataclass(frozen=True)
class Room:
    """A shoebox room with a robot's microphone, its loudspeaker and a human.

    rt60_s is what the impulse response shows. robot, human: responses (n,), of an array (microphones, n). elsewhere: the
    human's from further places.
    """

    rt60_s: float
    robot: Array
    human: Array
    elsewhere: tuple[Array, ...] = ()


def draw_room(rng: Rng, kind: str, robot_m: float, direction: Array, human_m: float) -> Room:
    """A room drawn by `draw_walls`, in which the robot stands somewhere (`stand`)."""
    return stand(rng, draw_walls(rng, kind), robot_m, direction, human_m)


def draw_walls(rng: Rng, kind: str) -> tuple[Array, float]:
    """Size in m (3,) and RT60 in s of an empty room. kind: "lab" (0.20-0.26 s) or "office" (0.50-0.75 s)."""
    low, high, scale = {"lab": (0.20, 0.26, 1.0), "office": (0.50, 0.75, 0.9)}[kind]
    size = scale * np.array([rng.uniform(5.0, 7.0), rng.uniform(4.0, 5.5), rng.uniform(2.6, 3.2) / scale])
    return size, rng.uniform(low, high)


def stand(
    rng: Rng,
    walls: tuple[Array, float],
    robot_m: float,
    direction: Array,
    human_m: float,
    array: Array | None = None,
    moves: int = 0,
) -> Room:
    """Impulse responses at 16 kHz by image sources (Allen & Berkley 1979; pyroomacoustics), without filter delay.

    walls: from `draw_walls`. robot_m, direction (3,): where the loudspeaker lies from the microphone; it is a part of
    the robot, so the same in every room. The human's mouth is human_m away, a little higher. array: (m, 3), where the
    microphones of an array lie from the microphone; None for the microphone alone. moves: further places of an array's
    human, as far away.
    """
    size, wanted = walls
    microphone = np.array([*rng.uniform(1.75, size[:2] - 1.75), rng.uniform(0.9, 1.2)])

    def mouth_somewhere() -> Array:
        angle, height = rng.uniform(0, 2 * math.pi), rng.uniform(0.1, 0.5)
        reach = math.sqrt(human_m**2 - height**2)
        return microphone + np.array([reach * math.cos(angle), reach * math.sin(angle), height])

    mouth = mouth_somewhere()
    asked = wanted
    # Sabine's formula misses the decay of an absorbing room by a quarter: ask again for what came out short
    for _ in range(3):
        (human,) = _image_sources(size, asked, microphone, (mouth,))
        found = float(pra.experimental.measure_rt60(human, fs=RATE, decay_db=30))
        asked, last = min(asked * wanted / found, 1.5), asked
    loudspeaker = microphone + robot_m * direction
    if array is not None:
        sources = (loudspeaker, mouth, *(mouth_somewhere() for _ in range(moves)))
        robot, human, *elsewhere = _image_sources(size, last, microphone + array, sources)
        return Room(found, robot, human, tuple(elsewhere))
    return Room(found, *_image_sources(size, last, microphone, (loudspeaker,)), human)


def _image_sources(size: Array, rt60_s: float, microphone: Array, sources: tuple[Array, ...]) -> list[Array]:
    """Of each source the response (n,) at a microphone (3,), or (m, n) at microphones (m, 3)."""
    absorption, order = pra.inverse_sabine(rt60_s, size)
    room = pra.ShoeBox(size, fs=RATE, materials=pra.Material(absorption), max_order=min(order, 60))
    for one in np.atleast_2d(microphone):
        room.add_microphone(one)
    for source in sources:
        room.add_source(source)
    room.compute_rir()
    skip = pra.constants.get("frac_delay_length") // 2
    found = []
    for heard in zip(*room.rir):
        responses = np.zeros((len(heard), max(one.size for one in heard) - skip))
        for row, one in zip(responses, heard):
            row[: one.size - skip] = one[skip:]
        found.append(responses if microphone.ndim > 1 else responses[0])
    return found


def draw_body(rng: Rng) -> Array:
    """Sound that the robot's own shell reflects within 2 ms, 10-20 dB below the direct sound, (32,)."""
    shell = np.zeros(32)
    shell[0] = 1.0
    for delay in rng.integers(3, 32, size=5):
        shell[delay] += rng.choice([-1, 1]) * 10 ** (-rng.uniform(10, 20) / 20)
    return shell


def draw_fan(rng: Rng) -> Array:
    """Amplitude response of a fan on 0-8000 Hz, of unit power, (1025,): flat, then falling, bumps, a blade line."""
    f = np.linspace(0, RATE / 2, 1025)
    corner = math.exp(rng.uniform(math.log(250), math.log(2500)))
    level_db = -10 * rng.uniform(0.8, 1.3) * np.log10(1 + (f / corner) ** 2)
    for centre in np.exp(rng.uniform(math.log(60), math.log(4000), size=4)):
        level_db += rng.uniform(-2, 5) * np.exp(-0.5 * (np.log2((f + 1) / centre) / 0.3) ** 2)
    level_db += rng.uniform(0, 8) * np.exp(-0.5 * ((f - rng.uniform(90, 240)) / 8.0) ** 2)
    amplitude = np.maximum(10 ** (level_db / 20), 10 ** (-30 / 20))
    return amplitude / math.sqrt(np.mean(amplitude**2))


def fan_noise(rng: Rng, amplitude: Array, n: int) -> Array:
    """Gaussian noise of unit power with that amplitude response, (n,)."""
    taps = signal.firwin2(2047, np.linspace(0, 1, amplitude.size), amplitude)
    return signal.oaconvolve(rng.standard_normal(n + taps.size - 1), taps, mode="valid")


@cache
def _between() -> Array:
    """Taps of a Kaiser-windowed sinc (beta 9: -90 dB) as Chebyshev series of the place between two samples, to 1e-15, (25, 64)."""

    def taps(place: Array) -> Array:
        distance = np.arange(-31, 33) - 0.5 * (place[:, None] + 1.0)
        return np.sinc(distance) * special.i0(9.0 * np.sqrt(1.0 - (distance / 32) ** 2)) / special.i0(9.0)

    return np.polynomial.chebyshev.chebinterpolate(taps, 24)


def warp(x: Array, ppm: float) -> Array:
    """Samples x (n,) read at t (1 + ppm 1e-6)."""
    if ppm == 0.0:
        return x.copy()
    taps, out = _between(), np.empty_like(x)
    width = taps.shape[1]
    read = sliding_window_view(np.pad(x, (width // 2 - 1, width + int(x.size * max(ppm, 0.0) * 1e-6))), width)
    for start in range(0, x.size, PIECE):
        position = np.arange(start, min(start + PIECE, x.size)) * (1.0 + ppm * 1e-6)
        whole = np.floor(position).astype(int)
        series = np.polynomial.chebyshev.chebvander(2.0 * (position - whole) - 1.0, len(taps) - 1)
        out[start : start + position.size] = np.einsum("ij,ij->i", read[whole], series @ taps)
    return out


def sweep(peak: float = 0.35) -> Array:
    """Exponential sweep (Farina 2000, eq. (2)), 40-8000 Hz in 6 s, 0.5 s of silence before, 1 s behind, (120000,)."""
    t = np.arange(6 * RATE) / RATE
    rate = math.log(8000 / 40)
    x = peak * np.sin(2 * math.pi * 40 * 6 / rate * (np.exp(t * rate / 6) - 1.0))
    fade = np.sin(0.5 * math.pi * np.arange(320) / 320) ** 2
    x[:320] *= fade
    x[-320:] *= fade[::-1]
    return np.concatenate([np.zeros(RATE // 2), x, np.zeros(RATE)])


@dataclass(frozen=True)
class Robot:
    """What does not change between rooms: loudspeaker, shell, geometry, converter delay, gain."""

    loudspeaker: Loudspeaker
    shell: Array
    distance_m: float
    direction: Array
    bulk: int

    def record(self, x: Array, response: Array, linear: bool = False) -> Array:
        """Microphone samples (n,) of x (n,) for a room's response, of an array (m, n), without fan or human."""
        path = signal.oaconvolve(response, self.shell, axes=-1)
        sound = self.loudspeaker.play(x, linear)
        heard = signal.oaconvolve(sound if path.ndim == 1 else sound[None], path, axes=-1)[..., : x.size - self.bulk]
        return np.concatenate([np.zeros((*path.shape[:-1], self.bulk)), heard], axis=-1)


def draw_robot(rng: Rng) -> Robot:
    direction = np.array([*rng.uniform(-1, 1, size=2), rng.uniform(-0.8, -0.1)])
    direction /= np.linalg.norm(direction)
    return Robot(draw_loudspeaker(rng), draw_body(rng), rng.uniform(0.1, 0.3), direction, int(rng.integers(250, 635)))


def with_distortion(robot: Robot, played: Array, response: Array, nl_db: float) -> tuple[Robot, float]:
    """The robot with its drive turned until the voice is distorted by nl_db (bisection), and the figure reached."""
    straight = robot.record(played, response, linear=True)
    low, high = math.log(0.01), math.log(100.0)
    for _ in range(9):
        middle = 0.5 * (low + high)
        robot = replace(robot, loudspeaker=replace(robot.loudspeaker, drive=math.exp(middle)))
        found = -si_sdr(robot.record(played, response), straight)
        low, high = (middle, high) if found < nl_db else (low, middle)
    return robot, found


def softened(echo: Array, softer: Array, ask_db: float) -> Array:
    """What to use in place of `echo` (n,) where a gain is to stand for a voice lowered by ask_db, whose echo `softer` (n,) distorts less.

    A gain of -ask_db takes off it what the microphone loses from `echo` to `softer`; with ask_db 0 it is `echo`.
    """
    lower = 10 ** (-ask_db / 20)
    return ((echo - softer) / (1 - lower) if ask_db else echo).astype(np.float32)
