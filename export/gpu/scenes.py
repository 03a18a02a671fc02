"""Conversations of export/simulate, drawn by numpy and rendered in torch, a whole batch at once, with the front end run over them.

Ranges are those of a Recipe. Simpler than export/simulate: the lag is known and constant, and so are volume and clock
(there is nothing to follow). An utterance is one recording; other voices are interpolated linearly. Rooms have image
sources to ORDER in each direction, at whole samples, and behind these noise that decays with the diffuse field's energy;
measured rooms are left out, measured loudspeakers and microphones not. Of the effects of the catalogue there are lost
packets and a path that changes; people in the background, hum and offset are left out, and what the filter has learned
before. A linear stage's taps and adaptation are drawn once for the warm and once for the cold ones of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy import signal
from torch import Tensor
from torch.nn.functional import interpolate, max_pool1d, pad

from edgefilter.dsp.stft import StftConfig
from edgefilter.filter.canceller import COLD, WARM
from edgefilter.filter.echo_path import TAPS
from edgefilter.filter.front_end import RUMBLE, RUMBLE_HZ
from edgefilter.types import SAMPLE_RATE
from export.gpu.front import cancel, convolved, expected_powers, power
from export.gpu.speech import Sounds, Voices
from export.rooms import RANGES
from export.simulate import fan, path, script
from export.simulate.conversation import LOUDEST, MOTORS_DB
from export.simulate.effects import PATH_CHANGE
from export.simulate.linear_stage import LEAST_DB, LOUDNESS_STEP_DB, Stage
from export.simulate.loudspeaker import SECOND
from export.simulate.microphone import WINDOW, Microphone, Suppression
from export.simulate.recipe import BENCHMARK, Recipe

SPEED = 343.0
"""Of sound, m/s."""
ORDER = 6
"""Image sources along each axis, to either side: complete for 29 m in the lowest room, 85 ms."""
ROOM_TAPS, PATH_TAPS, MICROPHONE_TAPS = SAMPLE_RATE // 2, SAMPLE_RATE // 2, 2048
COLD_TAPS = 6400
"""Of a canceller without a profile."""
COLOURS = 256
"""Devices that are drawn on the processor, once; each batch chooses from them."""


class Scenes:
    """Renders batches of conversations that depend on seed and number alone."""

    def __init__(self, recipe: Recipe, stft: StftConfig, sounds: Sounds, seed: int) -> None:
        self.recipe, self.stft, self.sounds, self.seed = recipe, stft, sounds, seed
        self.device = sounds.noise.device
        self.samples = round(recipe.seconds * SAMPLE_RATE) // stft.hop * stft.hop
        self._window = torch.from_numpy(stft.analysis_window.copy()).to(self.device)
        rng = np.random.default_rng(seed)
        bank = np.zeros((COLOURS, PATH_TAPS), np.float32)
        for row in bank:
            colour = path.path(np.ones(1, np.float32), path.device(rng, sounds.measured, recipe.wideness))
            row[: colour.size] = colour[: row.size]
        self.colours = torch.from_numpy(bank).to(self.device)

    @torch.no_grad()
    def render(self, number: int, count: int) -> dict[str, Tensor]:
        """A batch: mic, error, reference, clean, fan (count, n) float32, and noise, residual (count, n / hop, bins) uint8 as to_bytes has them."""
        return _Batch(self, np.random.default_rng([self.seed, number]), number, count).rendered()

    def spectra(self, x: Tensor) -> Tensor:
        """Frames of x (batch, n), from the one that ends with the first hop to the one behind the last, (batch, frames, bins)."""
        return torch.fft.rfft(pad(x, (self.stft.hop,) * 2).unfold(-1, self.stft.n_fft, self.stft.hop) * self._window)

    def sound(self, spectra: Tensor) -> Tensor:
        """The inverse of `spectra`: with a root-Hann window at half overlap the window is its own dual."""
        frames, hop = torch.fft.irfft(spectra, self.stft.n_fft) * self._window, self.stft.hop
        return (frames[:, :-1, hop:] + frames[:, 1:, :hop]).flatten(1)


class _Batch:
    """One batch under way; rng draws, noise on the device has a generator of its own."""

    def __init__(self, scenes: Scenes, rng: np.random.Generator, number: int, count: int) -> None:
        self.scenes, self.recipe, self.sounds, self.rng, self.count = scenes, scenes.recipe, scenes.sounds, rng, count
        self.n, self.device = scenes.samples, scenes.device
        self.plain = rng.random(count) < self.recipe.plain
        self.wide = np.where(self.plain, BENCHMARK.wideness, self.recipe.wideness)
        self.generator = torch.Generator(self.device).manual_seed(1_000_003 * scenes.seed + number)

    def between(self, name: str) -> np.ndarray:
        """A number of each, in its recipe's range."""
        ends = np.where(self.plain[:, None], getattr(BENCHMARK, name), getattr(self.recipe, name))
        return self.rng.uniform(ends[:, 0], ends[:, 1])

    def happens(self, share: str | float) -> np.ndarray:
        """In which of them; share: of the recipe, or of the wide ones."""
        if isinstance(share, float):
            return self.rng.random(self.count) < share * self.wide
        kept = share == "other_voices"
        plain = getattr(self.recipe if kept else BENCHMARK, share)
        return self.rng.random(self.count) < np.where(self.plain, plain, getattr(self.recipe, share))

    def each(self, values: np.ndarray) -> Tensor:
        """One number a conversation, (count, 1)."""
        return torch.from_numpy(np.asarray(values, np.float32)).to(self.device)[:, None]

    def white(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, device=self.device)

    def rendered(self) -> dict[str, Tensor]:
        rng, scenes = self.rng, self.scenes
        drawn = rng.random(self.count)
        office, hall = (
            np.where(self.plain, getattr(BENCHMARK, k), getattr(self.recipe, k)) for k in ("office", "hall")
        )
        kinds = np.where(drawn < office, "office", np.where(drawn < office + hall, "hall", "lab"))
        room, to_human = self.rooms(kinds)
        colour = scenes.colours[self.chosen(COLOURS)]
        response = convolved(colour, room)
        told, echo = self.robot(response)
        level = 0.08 * 10 ** (self.between("level_db") / 20)
        gain = self.each(level) / active_rms(echo)
        gain = torch.where(told.abs().amax(1, keepdim=True) > 0, gain, 0.0)
        near = self.happens("near_share")
        over_db = np.where(near, self.between("near_db"), self.between("human_gain_db"))
        human_rms = level * 10 ** (over_db / 20)
        clean = convolved(self.human(), to_human)
        clean = clean * self.each(human_rms) / active_rms(clean)
        steady, noise = self.noise(human_rms, level, told)
        noise = noise + self.knocks(clean, human_rms)
        warm, known, fan_db = self.profile(torch.where(gain > 0, gain, 1e-3) * response, colour)
        mic, clean, noise, (profile, steady) = self.recorded(gain * echo, clean, noise, (known, steady))
        fan_power = power(scenes.spectra(steady)).mean(1) * self.each(10 ** (fan_db / 10))
        settings = (BENCHMARK.setting, self.recipe.setting)
        stages = [settings[int(not p)].draw(rng, bool(w)) for p, w in zip(self.plain, warm, strict=True)]
        echo, uncertainty = self.cancelled(mic, told, warm, profile, stages)
        missing_db = np.array([np.nan if stage.missing_db is None else stage.missing_db for stage in stages])
        lost, weak = np.isposinf(missing_db), np.isfinite(missing_db)
        for row in np.flatnonzero(weak):
            taps = self.white(stages[row].missing_taps)
            echo[row] -= 10 ** (stages[row].missing_db / 20) * convolved(echo[row], taps / taps.norm())
        echo = torch.where(self.each(lost) > 0, 0.0, echo)
        warm_rows = torch.from_numpy(warm).to(self.device)
        cut = torch.from_numpy(np.where(self.scenes.stft.frequencies < RUMBLE_HZ, RUMBLE, 1.0)).to(mic)
        cut = torch.where(warm_rows[:, None, None], 1.0, cut)
        spectra = {name: cut * scenes.spectra(x) for name, x in (("mic", mic), ("error", mic - echo))}
        spectra |= {name: cut * scenes.spectra(x) for name, x in (("clean", clean), ("fan", noise), ("told", told))}
        found = {name: scenes.sound(spectrum) for name, spectrum in spectra.items()}
        reference = found.pop("told")
        for row in np.flatnonzero(lost):
            reference[row] = reference[row].roll(stages[row].displaced)
        error = spectra["error"][:, :-1]
        powers = expected_powers(spectra["mic"][:, :-1] - error, error, uncertainty, scenes.stft, warm_rows, fan_power)
        found |= dict(zip(("noise", "residual"), map(to_bytes, powers), strict=True))
        return found | {"reference": reference}

    def chosen(self, of: int) -> Tensor:
        return torch.from_numpy(self.rng.integers(of, size=self.count)).to(self.device)

    def rooms(self, kinds: np.ndarray) -> tuple[Tensor, Tensor]:
        """Responses from the robot's loudspeaker and from the human's mouth, from the direct sound on, (count, ROOM_TAPS)."""
        rng = self.rng
        ranges = np.array([RANGES[kind] for kind in kinds])  # length, width, RT60, distance
        length, width, rt60_s, far = np.moveaxis(rng.uniform(ranges[..., 0], ranges[..., 1]), -1, 0)
        size = np.stack((length, width, rng.uniform(2.4, 3.2, self.count)), 1)
        margin = (0.5, 0.5, 0.6)
        microphone = rng.uniform(margin, np.column_stack((size[:, :2] - 0.5, np.full(self.count, 1.4))))
        aside = rng.standard_normal((self.count, 3))
        aside *= rng.uniform(0.06, 0.3, (self.count, 1)) / np.linalg.norm(aside, axis=1, keepdims=True)
        angle = rng.uniform(0, 2 * np.pi, self.count)
        mouth = np.stack((far * np.cos(angle), far * np.sin(angle), rng.uniform(0, 0.7, self.count)), 1)
        mouth = np.clip(microphone + mouth, 0.2, size - 0.2)
        return self.response(size, rt60_s, microphone, microphone + aside), self.response(
            size, rt60_s, microphone, mouth
        )

    def response(self, size: np.ndarray, rt60_s: np.ndarray, microphone: np.ndarray, source: np.ndarray) -> Tensor:
        """Allen & Berkley (1979) to ORDER, then noise of the diffuse field's energy, 4 pi c / V a second times 10^(-6 t / RT60)."""
        volume = size.prod(1)
        surface = 2 * (size * np.roll(size, 1, 1)).sum(1)
        reflected = np.sqrt(1 - np.minimum(24 * np.log(10) / SPEED * volume / (surface * rt60_s), 0.99))
        number = np.arange(-ORDER, ORDER + 1)
        image = number * size[..., None] + np.where(number % 2, size[..., None] - source[..., None], source[..., None])
        apart = torch.from_numpy((image - microphone[..., None]).astype(np.float32)).to(self.device)
        x, y, z = apart.square().unbind(1)
        distance = (x[:, :, None, None] + y[:, None, :, None] + z[:, None, None, :]).sqrt().flatten(1)
        bounces = np.abs(number)
        walls = torch.from_numpy((bounces[:, None, None] + bounces[:, None] + bounces).ravel()).to(self.device)
        direct = torch.from_numpy(np.linalg.norm(source - microphone, axis=1).astype(np.float32)).to(self.device)[
            :, None
        ]
        complete = self.each((2 * ORDER - 1) / 2 * size.min(1))  # nearer than this no image is missing
        amplitude = torch.where(distance < complete, self.each(reflected) ** walls / distance.clamp(min=0.05), 0.0)
        places = ((distance - direct) / SPEED * SAMPLE_RATE).round().long().clamp(0, ROOM_TAPS - 1)
        taps = torch.zeros(self.count, ROOM_TAPS, device=self.device).scatter_add_(1, places, amplitude)
        seconds = direct / SPEED + torch.arange(ROOM_TAPS, device=self.device) / SAMPLE_RATE
        density = 4 * np.pi * SPEED / SAMPLE_RATE / self.each(volume) * 10 ** (-6 * seconds / self.each(rt60_s))
        tail = density.sqrt() * self.white(self.count, ROOM_TAPS)
        return torch.where(seconds * SPEED < complete, taps, tail) * direct

    def speech(
        self, voices: Voices, into: Tensor, begins_s: float, lasts_s: tuple[float, float], pause_s: tuple[float, float],
        other: bool, soft: bool = False
    ) -> None:  # fmt: skip
        """Utterances of one speaker, written into a silence (n,)."""
        rng, at = self.rng, int(begins_s * SAMPLE_RATE)
        speaker = voices.corpus.draw_speaker(rng)
        rate = int(rng.integers(script.RATES[0], script.RATES[1] + 1)) if other else 100
        while at < self.n - SAMPLE_RATE // 2:
            said = voices.draw(rng, speaker, int(rng.uniform(*lasts_s) * SAMPLE_RATE))
            if rate != 100:
                said = interpolate(said[None, None], scale_factor=100 / rate, mode="linear")[0, 0]
            if soft:
                said = said * torch.from_numpy(script.rise(rng, said.numel())).to(self.device)
            said = said[: self.n - at]
            into[at : at + said.numel()] = said
            at += said.numel() + int(rng.uniform(*pause_s) * SAMPLE_RATE)

    def robot(self, response: Tensor) -> tuple[Tensor, Tensor]:
        """The references, and their echoes through this response, (count, n) each."""
        told, rng = torch.zeros(self.count, self.n, device=self.device), self.rng
        talks, person, other = (self.happens(share) for share in ("robot", "far_human", "other_voices"))
        for row in np.flatnonzero(talks):
            voices = self.sounds.humans if person[row] else self.sounds.robots
            self.speech(voices, told[row], rng.uniform(0, 0.6), (2, 7), (0.3, 1.2), bool(other[row]))
        played = told * self.packets(self.happens(self.recipe.catalogue / 4))
        echo = convolved(self.distorted(played), response)
        changes = self.happens(PATH_CHANGE)
        seconds = torch.arange(2048, device=self.device) / SAMPLE_RATE
        taps = 10 ** (-3 * seconds / self.each(rng.uniform(0.02, 0.3, self.count))) * self.white(self.count, 2048)
        taps *= self.each(10 ** (rng.uniform(-20, 0, self.count) / 20)) / taps.norm(dim=1, keepdim=True)
        at, lasts = rng.uniform(0.2, 0.9, self.count) * self.n, rng.uniform(0.01, 1, self.count) * SAMPLE_RATE
        return told, echo + self.each(changes) * self.ramp(at, lasts) * convolved(echo, taps)

    def ramp(self, at: np.ndarray, lasts: np.ndarray) -> Tensor:
        """0 before `at`, 1 from `lasts` samples later on, (count, n)."""
        return ((torch.arange(self.n, device=self.device) - self.each(at)) / self.each(lasts)).clamp(0, 1)

    def packets(self, some: np.ndarray) -> Tensor:
        """0 where a packet of 10 to 60 ms is lost, else 1, (count, n)."""
        kept = torch.ones(self.count, self.n, device=self.device)
        for row in np.flatnonzero(some):
            size = int(self.rng.choice((160, 320, 480, 640, 960)))
            lost = self.rng.random(-(-self.n // size)) < 10 ** self.rng.uniform(-2.5, -1.0)
            kept[row, torch.from_numpy(np.repeat(lost, size)[: self.n]).to(self.device)] = 0.0
        return kept

    def distorted(self, x: Tensor) -> Tensor:
        """Add one or two kinds of distortion, at the recipe's level over x, of what is not x again (simulate.loudspeaker.distorted)."""
        rms, level = active_rms(x), self.each(10 ** (self.between("distortion_db") / 20))
        added = torch.zeros_like(x)
        second = self.rng.random(self.count) < np.where(self.plain, 0.0, SECOND)
        kinds = self.rng.integers(len(KINDS), size=(2, self.count))
        kinds[0, self.plain] = 0  # the driver
        for at, distort in enumerate(KINDS):
            for rows in (np.flatnonzero(kinds[0] == at), np.flatnonzero((kinds[1] == at) & second)):
                if rows.size:
                    part = distort(self, x[rows] / rms[rows]) * rms[rows]
                    part = part - (part * x[rows]).sum(1, True) / (x[rows].square().sum(1, True) + 1e-9) * x[rows]
                    size = active_rms(part)  # a compressor that is never reached leaves rounding errors
                    added[rows] += torch.where(size > 1e-4 * rms[rows], part / size, 0.0)
        return x + level * rms / active_rms(added) * added

    def human(self) -> Tensor:
        """The human's speech without a room, (count, n)."""
        spoken = torch.zeros(self.count, self.n, device=self.device)
        other, soft, begins_s = self.happens("other_voices"), self.happens("soft"), self.between("silence_s")
        for row in np.flatnonzero(self.happens("human")):
            self.speech(
                self.sounds.humans, spoken[row], begins_s[row], (1.5, 7), (0.5, 3), bool(other[row]), bool(soft[row])
            )
        return spoken

    def recording(self) -> Tensor:
        """A stretch of recorded noise of each, of an RMS of 1, (count, n)."""
        noise = self.sounds.noise
        starts = torch.from_numpy(self.rng.integers(noise.numel(), size=self.count)).to(self.device)
        sound = noise[(starts[:, None] + torch.arange(self.n, device=self.device)) % noise.numel()]
        return sound / (sound.square().mean(1, keepdim=True).sqrt() + 1e-9)

    def fans(self) -> Tensor:
        """Noise of fans (simulate.fan.amplitude), of an RMS of 1, (count, n)."""
        curves = torch.from_numpy(np.array([fan.amplitude(self.rng) for _ in range(self.count)], np.float32))
        spectrum = torch.fft.rfft(self.white(self.count, self.n))
        gains = interpolate(curves[:, None].to(self.device), spectrum.shape[1], mode="linear", align_corners=True)[:, 0]
        sound = torch.fft.irfft(spectrum * gains, self.n)
        return sound / sound.square().mean(1, keepdim=True).sqrt()

    def noise(self, human_rms: np.ndarray, level: np.ndarray, played: Tensor) -> tuple[Tensor, Tensor]:
        """The steady fan, and all that is neither human nor robot, (count, n) each."""
        rng = self.rng
        under_db = np.where(self.happens("quiet_fan"), rng.uniform(20, 45, self.count), self.between("fan_db"))
        recorded = self.happens(fan.RECORDED) & (self.sounds.noise.numel() > 1)
        steady = torch.where(self.each(recorded) > 0, self.recording(), self.fans())
        steady = steady * self.each(human_rms * 10 ** (-under_db / 20))
        at, lasts = rng.uniform(0.1, 0.8, self.count) * self.n, rng.uniform(0.3, 4, self.count) * SAMPLE_RATE
        change_db = self.each(rng.uniform(-8, 8, self.count) * self.happens(fan.CHANGING))
        total = steady * 10 ** (change_db / 20 * self.ramp(at, lasts))
        behind = human_rms * 10 ** (-rng.uniform(5, 30, self.count) / 20) * self.happens(fan.BACKGROUND)
        total = total + self.each(behind) * self.recording()
        moving = self.each(level * 10 ** (rng.uniform(*MOTORS_DB, self.count) / 20) * self.happens("motors"))
        return steady, total + moving * self.moved(played) * self.fans()

    def knocks(self, clean: Tensor, human_rms: np.ndarray) -> Tensor:
        """Stretches of recorded noise that fade, while the human is silent, (count, n); simulate.fan.knocks."""
        seconds, total = torch.arange(self.n, device=self.device) / SAMPLE_RATE, torch.zeros_like(clean)
        rms = human_rms * self.happens("knocks")
        for _ in range(fan.KNOCKS // 2):
            at, lasts = (self.rng.uniform(*ends, self.count) for ends in ((0, self.n / SAMPLE_RATE), fan.KNOCK_S))
            passed = (seconds - self.each(at)) / self.each(lasts)
            level = self.each(rms * 10 ** (self.rng.uniform(*fan.KNOCK_DB, self.count) / 20))
            total += level * torch.where((passed >= 0) & (passed < 1), 1 - passed, 0.0) * self.recording()
        near = max_pool1d(clean.abs()[:, None], SAMPLE_RATE // 10 + 1, 1, SAMPLE_RATE // 20)[:, 0]
        return total * (near <= 1e-3 * near.amax(1, keepdim=True))

    def moved(self, played: Tensor) -> Tensor:
        """How much a robot moves that talks, 0 to 1, (count, n): its loudness over 0.1 to 0.6 s."""
        width = self.each(self.rng.uniform(0.1, 0.6, self.count) * SAMPLE_RATE)
        box = (torch.arange(SAMPLE_RATE, device=self.device) < width).float() / width
        loud = convolved(played.abs(), box).clamp(min=0.0)
        most = loud[:, ::160].quantile(0.9, 1, keepdim=True).clamp(min=1e-9)
        return (loud / most).clamp(max=1.0) ** self.each(self.rng.uniform(0.3, 1.5, self.count))

    def recorded(
        self, echo: Tensor, clean: Tensor, noise: Tensor, measured: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """What microphones make of all together, of human and noise, and of what was measured by them before, at their level."""
        each = [
            Microphone.draw(self.rng, wide, self.recipe.seconds, 0.0 if plain else self.recipe.processed)
            for wide, plain in zip(self.wide, self.plain, strict=True)
        ]
        impulse = np.eye(1, MICROPHONE_TAPS, dtype=np.float32)[0]
        taps = torch.from_numpy(np.array([microphone.filtered(impulse) for microphone in each])).to(self.device)
        gain = torch.ones_like(echo)
        for row, microphone in enumerate(each):
            if microphone.gain_db is not None:
                gain[row] = torch.from_numpy(microphone.gain(self.n)).to(self.device)
        heard = [gain * convolved(x, taps) for x in (echo + clean + noise, clean, noise)]
        for row, microphone in enumerate(each):
            if microphone.suppression:
                for x, suppressed in zip(heard, suppress(microphone.suppression, [x[row] for x in heard]), strict=True):
                    x[row] = suppressed
        peak = heard[0].abs().amax(1, keepdim=True).clamp(min=1e-9)
        scale = (LOUDEST / peak).clamp(max=1.0)
        limit = self.each([microphone.clip for microphone in each]) * peak * scale
        mic, clean, noise = (scale * x for x in heard)
        return mic.clamp(-limit, limit), clean, noise, [scale * convolved(x, taps) for x in measured]

    def profile(self, now: Tensor, colour: Tensor) -> tuple[np.ndarray, Tensor, np.ndarray]:
        """Which have one, its path (count, taps), measured elsewhere, and by how many decibels its fan is off.

        Some are wrong, in level, device or all but loudness. now: the robot's path in this room; colour: of its device.
        """
        rng = self.rng
        warm, wrong = (np.where(self.plain, getattr(BENCHMARK, k), getattr(self.recipe, k)) for k in ("warm", "wrong"))
        drawn, which = rng.random(self.count), rng.integers(3, size=self.count)
        which[(drawn < warm) | (drawn >= warm + wrong)] = -1
        colour = torch.where(self.each(which == 1) > 0, self.scenes.colours[self.chosen(COLOURS)], colour)
        known = convolved(colour, self.rooms(np.full(self.count, "lab"))[0])
        part = SAMPLE_RATE // 8
        for row in np.flatnonzero(which == 2):  # nothing to do with this path but its loudness
            known[row, :part] = known[row, torch.from_numpy(rng.permutation(part)).to(self.device)]
            known[row, part:] = 0.0
        loudness = now.norm(dim=1, keepdim=True) / known.norm(dim=1, keepdim=True).clamp(min=1e-9)
        peaks = now.abs().amax(1, keepdim=True) / known.abs().amax(1, keepdim=True).clamp(min=1e-9)
        known = known * torch.where(self.each(which > 0) > 0, loudness, peaks)
        off_db = np.where(which == 0, rng.uniform(-10, 10, self.count), rng.uniform(-1, 1, self.count))
        fan_db = np.where(which == 0, rng.choice((-6, 6), self.count), 0) + rng.uniform(-0.6, 0.6, self.count)
        return drawn < warm + wrong, known * self.each(10 ** (off_db / 20)), fan_db

    def cancelled(
        self, mic: Tensor, told: Tensor, warm: np.ndarray, profile: Tensor, stages: list[Stage]
    ) -> tuple[Tensor, Tensor]:
        """Echo (count, n) and uncertainty (count, frames, bins) by cancellers that start from the profile or from nothing."""
        hop = self.scenes.stft.hop
        echo, uncertainty = torch.zeros_like(mic), mic.new_zeros(self.count, self.n // hop, hop + 1)
        for rows, usual, taps in (
            (np.flatnonzero(warm), WARM, int(np.clip(PATH_TAPS, *TAPS))),
            (np.flatnonzero(~warm), COLD, COLD_TAPS),
        ):
            if rows.size:
                stage = stages[int(self.rng.choice(rows))]
                known = profile[rows] if usual is WARM else None
                adaptation = stage.adaptation or usual
                echo[rows], uncertainty[rows] = cancel(
                    mic[rows], told[rows], hop, stage.taps or taps, adaptation, known
                )
        return echo, uncertainty


def active_rms(x: Tensor) -> Tensor:
    """RMS over the 20 ms stretches within 30 dB of the loudest, of each (batch, n), (batch, 1); never 0."""
    parts = x[:, : x.shape[1] // 320 * 320].unflatten(1, (-1, 320)).square().mean(-1)
    loud = parts > 1e-3 * parts.amax(1, keepdim=True)
    return ((parts * loud).sum(1, True) / loud.sum(1, True).clamp(min=1)).sqrt().clamp(min=1e-9)


def to_bytes(level: Tensor) -> Tensor:
    """simulate.linear_stage.to_bytes on tensors."""
    return ((10 * torch.log10(level + 1e-12) - LEAST_DB) / LOUDNESS_STEP_DB).round().clamp(0, 255).to(torch.uint8)


def suppress(suppression: Suppression, signals: list[Tensor]) -> list[Tensor]:
    """simulate.microphone.Suppression.applied on tensors (n,); the gain of the first is that of all."""
    size, hop = WINDOW.mfft, WINDOW.hop
    window = torch.hann_window(size, device=signals[0].device)
    spectra = torch.stft(torch.stack(signals), size, hop, window=window, return_complex=True)
    heard = power(spectra[0])
    gain = 1.0 - suppression.over * heard.quantile(0.1, 1, keepdim=True) / heard.clamp(min=1e-12)
    gain = gain.clamp(min=10 ** (suppression.floor_db / 20))
    falling = 0.3 * 0.7 ** torch.arange(64, device=gain.device)
    gain = torch.maximum(gain, convolved(gain, falling))
    rng = np.random.default_rng(suppression.seed)
    bins, frames = gain.shape
    knots = 2 + int(suppression.jitter_hz * signals[0].numel() / SAMPLE_RATE)
    jitter = rng.normal(0.0, suppression.jitter_db, (suppression.jitter_bands, knots)).astype(np.float32)
    places = torch.from_numpy(jitter).to(gain)[None]
    jitter_db = interpolate(places, size=frames, mode="linear", align_corners=True)[0]
    bands = torch.arange(bins, device=gain.device) * suppression.jitter_bands // bins
    gain = gain * 10 ** (jitter_db[bands] / 20)
    return list(torch.istft(gain * spectra, size, hop, window=window, length=signals[0].numel()))


def _filtered(x: Tensor, sections: Sequence[np.ndarray]) -> Tensor:
    """Each of x (rows, n) through second-order sections of its own."""
    impulse = np.eye(1, MICROPHONE_TAPS)[0]
    taps = np.array([signal.sosfilt(each, impulse) for each in sections], np.float32)
    return convolved(x, torch.from_numpy(taps).to(x.device))


def _uniform(batch: _Batch, x: Tensor, low: float, high: float) -> Tensor:
    return torch.from_numpy(batch.rng.uniform(low, high, (x.shape[0], 1)).astype(np.float32)).to(x.device)


def _low_passed(batch: _Batch, x: Tensor, low: float, high: float, order: int = 2) -> Tensor:
    corners = batch.rng.uniform(low, high, x.shape[0])
    return _filtered(x, [signal.butter(order, hz, fs=SAMPLE_RATE, output="sos") for hz in corners])


def _driver(batch: _Batch, x: Tensor) -> Tensor:
    moved = _low_passed(batch, x, 120, 420)
    d = 10 ** _uniform(batch, x, -0.3, 0.7) * moved / active_rms(moved)
    bound = 1.0 / (1.0 + d * d)
    added = x * (_uniform(batch, x, -1, 1) * d * bound - _uniform(batch, x, 0, 1) * d * d * bound)
    return x + added + _uniform(batch, x, 0, 0.3) * torch.tanh(x)


def _soft(batch: _Batch, x: Tensor) -> Tensor:
    drive, bias = 10 ** _uniform(batch, x, -0.5, 0.5), _uniform(batch, x, -0.5, 0.5)
    return (torch.tanh(drive * x + bias) - torch.tanh(bias)) / drive


def _hard(batch: _Batch, x: Tensor) -> Tensor:
    limit = _uniform(batch, x, 1, 3)
    return x.clamp(-limit, _uniform(batch, x, 0.7, 1) * limit)


def _crossover(batch: _Batch, x: Tensor) -> Tensor:
    return x.sign() * (x.abs() - _uniform(batch, x, 0.02, 0.3)).clamp(min=0.0)


def _compressor(batch: _Batch, x: Tensor) -> Tensor:
    """One time for attack and release."""
    seconds = torch.arange(SAMPLE_RATE // 2, device=x.device) / SAMPLE_RATE
    falling = torch.exp(-seconds / 10 ** _uniform(batch, x, -2.7, -0.7))
    level = convolved(x.square(), falling / falling.sum(1, keepdim=True)).clamp(min=1e-9)
    over_db = (10 * torch.log10(level) - _uniform(batch, x, -15, 6)).clamp(min=0.0)
    return x * 10 ** (-over_db * (1 - 1 / _uniform(batch, x, 2, 20)) / 20)


def _rattle(batch: _Batch, x: Tensor) -> Tensor:
    rng, rows = batch.rng, x.shape[0]
    peaks = [signal.iirpeak(rng.uniform(80, 500), rng.uniform(2, 12), fs=SAMPLE_RATE) for _ in range(rows)]
    swing = _filtered(x, [signal.tf2sos(*peak) for peak in peaks])
    beyond = swing > _uniform(batch, x, 1, 2.5) * active_rms(swing)
    knocks = pad((beyond[:, 1:] & ~beyond[:, :-1]).float(), (1, 0)) * (0.65 + 0.35 * torch.tanh(batch.white(*x.shape)))
    seconds = torch.arange(1600, device=x.device) / SAMPLE_RATE
    lows = rng.uniform(300, 2500, rows)
    bands = [(low, min(7500.0, low * rng.uniform(1.5, 4))) for low in lows]
    bursts = _filtered(
        batch.white(*x.shape), [signal.butter(2, band, "bandpass", fs=SAMPLE_RATE, output="sos") for band in bands]
    )
    return x + convolved(knocks, torch.exp(-seconds / _uniform(batch, x, 0.002, 0.02))) * bursts


def _codec(batch: _Batch, x: Tensor) -> Tensor:
    """One frame length and width of bands for all."""
    size, width = int(batch.rng.choice((256, 512, 1024))), int(batch.rng.integers(4, 12))
    window = torch.hann_window(size, device=x.device)
    frames = torch.stft(x, size, size // 2, window=window, return_complex=True)
    bins = frames.shape[1]
    bands = pad(power(frames), (0, 0, 0, -bins % width)).unflatten(1, (-1, width)).mean(2)
    step = (_uniform(batch, x, 0.5, 2.5)[..., None] * bands.sqrt()).repeat_interleave(width, 1)[:, :bins] + 1e-9
    coded = step * torch.complex((frames.real / step).round(), (frames.imag / step).round())
    hz = torch.linspace(0, SAMPLE_RATE / 2, bins, device=x.device)[:, None]
    coded = torch.where(hz > _uniform(batch, x, 3800, 8001)[..., None], 0.0, coded)
    return torch.istft(coded, size, size // 2, window=window, length=x.shape[1])


def _bands(batch: _Batch, x: Tensor, low: tuple[float, float], high: tuple[float, float]) -> list[Tensor]:
    below, under = _low_passed(batch, x, *low, order=1), _low_passed(batch, x, *high, order=1)
    return [below, under - below, x - under]


def _multiband(batch: _Batch, x: Tensor) -> Tensor:
    total = torch.zeros_like(x)
    for band in _bands(batch, x, (200, 1000), (1000, 5000)):
        drive = 10 ** _uniform(batch, x, -0.7, 0.7) / active_rms(band)
        total = total + torch.tanh(drive * band) / drive
    return total


def _flutter(batch: _Batch, x: Tensor) -> Tensor:
    """One rate for all."""
    knots = int(x.shape[1] / SAMPLE_RATE * batch.rng.uniform(2, 25)) + 2
    total = torch.zeros_like(x)
    for band in _bands(batch, x, (300, 900), (1200, 4000)):
        gains = interpolate(batch.white(x.shape[0], 1, knots), size=x.shape[1], mode="linear", align_corners=True)[:, 0]
        total = total + band * (1.0 + 0.3 * gains)
    return total


KINDS: tuple[Callable[[_Batch, Tensor], Tensor], ...] = (
    _driver,
    _soft,
    _hard,
    _crossover,
    _compressor,
    _rattle,
    _codec,
    _multiband,
    _flutter,
)
"""simulate.loudspeaker.KINDS on tensors: x (rows, n) with an active RMS of 1 to what comes out; rows differ in all but what is said."""
