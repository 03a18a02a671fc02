"""Learning beside the running filter: fit the loudspeaker, replay the last minute with it, and let the result prove itself."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import signal

from edgefilter.dsp.psd import floored
from edgefilter.echo.effect import complete, vanishes
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel
from edgefilter.errors import ProfileError
from edgefilter.filter.adaptation import COLD
from edgefilter.filter.canceller import Canceller
from edgefilter.filter.echo_path import TAPS, EchoPath, Effects, PathState, starting_path
from edgefilter.filter.learner import Heard, Lesson
from edgefilter.learning.contest import Rival
from edgefilter.learning.remember import learned_profile
from edgefilter.learning.shared import PAST
from edgefilter.learning.tape import Tape, emphasised
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

MINUTE = 60.0
FIRST_S, FACTOR, EVERY_S = 2.0, 1.5, 20.0
"""Seconds of audible robot until the first fit, the factor to the next one, and the longest wait."""
AUDIBLE = 1e-2
"""The robot is audible where the reference's power is within 20 dB of its recent peak, which fades by ..."""
FADE = 0.9995
"""... this factor a hop."""
WORTH_S = 5.0
"""Seconds of audible robot from which on what was learned may be worth keeping."""
BEFORE = "the path of before"
PSD_FFT = 1200
MOMENT, QUIET = 4800, 1e-4
"""Samples over which the reference's power is taken, and how far below its highest sample's it teaches nothing."""
SHORT_S, TIMES = 15.0, 3
"""So few seconds teach more where they are heard several times."""


class PathLearner:
    """Learns from every hop it is told, and answers with a lesson where a better path has proved itself.

    Parameters
    ----------
    profile : Profile, optional
        What the filter began with.
    remember : Path, optional
        Where to keep what was learned, as a profile for the next time: after each fit and at the end, wherever a filter
        that begins with it leaves less of the last minute than one that begins with `profile`.

    Notes
    -----
    It keeps the last minute. Now and then it fits the loudspeaker's effects to it, lets a filter that knows them from
    the beginning hear the minute, and then runs that filter beside the one in use. Where it predicts clearly better
    what neither has heard before, it is the lesson; the one that it replaces runs on and comes back where it proves the
    better one. All follows from the hops alone: the same recording teaches the same.

    Examples
    --------
    >>> import edgefilter
    >>> learner = edgefilter.PathLearner()
    >>> ego = edgefilter.EgoFilter(engine="linear", learn=learner)
    >>> learner.stats()["learned"]
    0
    """

    past = PAST

    def __init__(self, profile: Profile | None = None, remember: Path | None = None) -> None:
        self._profile, self._remember = profile, remember
        self._audible_s = 0.0
        self._counts = {"rounds": 0, "learned": 0, "unlearned": 0, "remembered": 0}

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins with that path."""
        self._hop, self._begin = hop, path
        known = path.canceller.weights.any()
        self._response = Canceller.resumed(path.canceller, hop).impulse_response() if known else None
        self._silence = np.zeros(self.past, np.float32)
        self._tape = Tape(hop, MINUTE)
        self._running = self._resumed(path)
        self._rivals = [Rival(self._running, "no lesson at all", "unlearned", stays=True)]
        if known:
            self._rivals.append(Rival(self._fresh((), None, products=False), "a path from nothing", stays=True))
        self._audible_s, self._next_s, self._peak = 0.0, FIRST_S, 0.0
        self._counts = {"rounds": 0, "learned": 0, "unlearned": 0, "remembered": 0}

    def hear(self, heard: Heard) -> Lesson | None:
        """Take one hop; compare, and now and then fit."""
        self._tape.append(heard)
        self._running.step(heard.mic, heard.reference, heard.located, heard.past)
        audible = self._audible(heard)
        left = emphasised(heard.innovation)
        for rival in self._rivals:
            if rival.path is not self._running:
                rival.step(heard, left, audible)
        won = [rival for rival in self._rivals if rival.won]
        if won:
            return self._adopt(max(won, key=lambda rival: rival.gain_db))
        self._rivals = [rival for rival in self._rivals if not rival.over]
        if audible and self._audible_s >= self._next_s:
            self._next_s = min(self._next_s * FACTOR, self._next_s + EVERY_S)
            self._rivals = [rival for rival in self._rivals if rival.stays] + self._candidates()
            with suppress(ProfileError):  # it is tried again, and told of, at the end; the sound goes on
                self._keep()
        return None

    def stats(self) -> dict[str, object]:
        """What was learned so far."""
        return {**self._counts, "heard_s": round(self._audible_s, 2)}

    def close(self) -> None:
        """Keep what was learned, where it is to be remembered and worth it.

        Raises
        ------
        ProfileError
            Where the file cannot be written.
        """
        self._keep()

    def _audible(self, heard: Heard) -> bool:
        power = float(heard.reference.dot(heard.reference))
        self._peak = max(power, FADE * self._peak)
        audible = heard.located and power > AUDIBLE * self._peak and power > 1e-8
        self._audible_s += audible * self._hop / SAMPLE_RATE
        return audible

    def _adopt(self, winner: Rival) -> Lesson:
        self._counts[winner.kind] += 1
        detail = f"{winner.was}: {winner.gain_db:.1f} dB less is left of the robot"
        self._rivals = [rival for rival in self._rivals if rival.stays and rival.was != BEFORE]
        for rival in self._rivals:
            rival.forget()
        if all(rival.path is not self._running for rival in self._rivals):
            self._rivals.append(Rival(self._running, BEFORE, "unlearned", stays=True))
        self._running = winner.path
        return Lesson(winner.path.state(), winner.kind, detail)

    def _candidates(self) -> list[Rival]:
        """Paths that have heard the tape: from the beginning with what it teaches of the loudspeaker, and without.

        And from nothing, with its newest seconds alone: the robot may stand elsewhere than at the beginning, or than a
        minute ago.
        """
        self._counts["rounds"] += 1
        known, fitted = self._begin.effects, self._fitted()
        short = self._audible_s < SHORT_S
        rivals = [Rival(self._fresh(known, self._response), "path")]
        if any(find(name).learned for name, _ in fitted):
            rivals.append(Rival(self._fresh(fitted, self._response), "loudspeaker and path"))
        for rival in rivals:
            for _ in range(TIMES if short else 1):
                self._tape.replay(rival.path)
        if self._response is not None or not short:
            elsewhere = self._fresh(fitted, None)
            for _ in range(TIMES):
                self._tape.replay(elsewhere, SHORT_S)
            rivals.append(Rival(elsewhere, "another path"))
        return rivals

    def _fitted(self) -> Effects:
        """The effects of the beginning, those that can be learned as they explain the tape."""
        mic, reference, innovation = self._tape.signals()
        power = np.square(reference)
        loud = signal.oaconvolve(power, np.full(MOMENT, 1 / MOMENT))[: mic.size] > QUIET * float(power.max())
        use = self._tape.straight() & loud
        effects = self._begin.effects
        if use.sum() < FIRST_S * SAMPLE_RATE / 2:
            return effects
        measurement = Measurement(reference, mic, psd(innovation[use]), use)
        path = self._running.canceller.impulse_response()
        for effect in EFFECTS:
            if effect.learned:
                others = tuple(entry for entry in effects if entry[0] != effect.name)
                model = EchoModel(path, tuple(entry for entry in others if entry[0] in SOURCES))
                try:
                    values = complete(effect, effect.fit(measurement, model))
                except (ArithmeticError, np.linalg.LinAlgError):  # what cannot be fitted is not learned
                    continue
                effects = others if vanishes(effect, values) else (*others, (effect.name, values))
        return effects

    def _fresh(self, effects: Effects, response: Samples | None, products: bool = True) -> EchoPath:
        """A path with those effects that starts from an impulse response, or from nothing, and has heard nothing."""
        begin = self._begin.canceller.adaptation
        if response is None:
            begin = replace(COLD, posterior=begin.posterior)
        adaptation = replace(begin, products=products)
        return EchoPath(Canceller(self._hop, TAPS[1], response, adaptation), effects)

    def _keep(self) -> None:
        """Write the file where whoever begins with it is better off."""
        if self._remember is None or self._audible_s < WORTH_S:
            return
        learned = learned_profile(self._profile, self._running, self._tape)
        if self._left(learned) < self._left(self._profile):
            learned.save(self._remember)
            self._counts["remembered"] += 1

    def _left(self, profile: Profile | None) -> float:
        """What a filter that begins with that profile leaves of the last minute."""
        return self._tape.replay(starting_path(profile, self._hop))

    def _resumed(self, state: PathState) -> EchoPath:
        return EchoPath.resumed(state, self._silence, self._hop)


SOURCES = tuple(effect.name for effect in EFFECTS if effect.stage == "source")


def psd(x: Samples) -> Samples:
    """(601,) one-sided power spectral density of x (n,)."""
    return floored(signal.welch(x, SAMPLE_RATE, nperseg=PSD_FFT, detrend=False)[1]).astype(np.float32)
