"""Learning beside the running filter: fit the loudspeaker, replay the last minute with it, compare the result on new hops."""

from __future__ import annotations

import datetime
import math
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from edgefilter.alignment.utterances import Sustained
from edgefilter.calibration.calibrate import cross_density, first
from edgefilter.calibration.from_recording import fan_in_silences, profile_of
from edgefilter.dsp.psd import floored, periodograms
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.echo.measurement import Measurement, whiten
from edgefilter.echo.model import EchoModel
from edgefilter.errors import ProfileError
from edgefilter.filter.canceller import COLD, Canceller
from edgefilter.filter.echo_path import PAST, TAPS, EchoPath, Effects, FilteredHop, PathState, PathUpdate, starting_path
from edgefilter.filter.volume import AUDIBLE, WITNESSES
from edgefilter.learning.history import MINUTE, NOTHING_LEARNED, RECENT_S, HopHistory, emphasised
from edgefilter.profile.array import ArrayCalibration
from edgefilter.profile.data import GRID_FFT, LEARNED, Profile
from edgefilter.types import SAMPLE_RATE, EventKind, Samples, expect_positive

BEFORE = "the path of before"


@dataclass(frozen=True)
class Schedule:
    """When the learner fits, and when a candidate path wins or is given up. Raises UsageError for what is not above 0."""

    first_s: float = 2.0
    """Seconds of audible robot until the first fit."""
    factor: float = 1.5
    """Factor by which the wait between two fits grows, up to MINUTE; it is RECENT_S again after another path was taken over."""
    fade: float = 0.9995
    """The robot is AUDIBLE where the reference's power is that near to its recent peak, which fades by this factor a hop."""
    times: int = 3
    """How often RECENT_S of sound, where there is no more, is replayed to a new path: once is too little to converge."""
    least: int = 8
    """Blocks of WITNESSES hops each, whose errors are compared as one, after which a candidate can win."""
    most: int = 60
    """Blocks after which it is given up."""
    gain_db: float = 0.15
    """Mean fall of the error by which a candidate wins."""
    certain: float = 2.5
    """How many of its standard errors that must be: a human adds the same error to both."""

    def __post_init__(self) -> None:
        expect_positive(asdict(self))


SCHEDULE = Schedule()


@dataclass
class CandidatePath:
    """A path that is compared, hop by hop, with the one in use.

    was: what to call it. kind: of the event where it wins. stays: whether it is a standing one, compared by its latest
    1.5 s, since what was right a minute ago does not count, and never given up. gains_db: (blocks,) by how much less it left.
    """

    path: EchoPath
    was: str
    kind: EventKind = "learned"
    stays: bool = False
    gains_db: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._its = self._running = 1e-12
        self._count = 0

    def step(self, hop: FilteredHop, running: float, audible: bool) -> None:
        """Step it through a hop, too. running: power, emphasised, of what the path in use left of the hop."""
        left = emphasised(self.path.step(hop.mic, hop.reference, hop.located, hop.past).innovation)
        if not audible:
            return
        self._its, self._running, self._count = self._its + left, self._running + running, self._count + 1
        if self._count == WITNESSES:
            self.gains_db.append(10.0 * math.log10(self._running / self._its))
            self._begin()
            if self.stays:
                del self.gains_db[: -2 * SCHEDULE.least]

    def restart(self) -> None:
        """Another path is in use now: the comparisons so far say nothing any more."""
        self.gains_db.clear()
        self._begin()

    @property
    def gain_db(self) -> float:
        """Mean of the gains, of which there must be one."""
        return float(np.mean(self.gains_db))

    @property
    def won(self) -> bool:
        """Whether it is clearly the better one."""
        count = len(self.gains_db)
        if count < SCHEDULE.least or self.gain_db < SCHEDULE.gain_db:
            return False
        return self.gain_db > SCHEDULE.certain * float(np.std(self.gains_db, ddof=1)) / math.sqrt(count)

    @property
    def over(self) -> bool:
        """Whether the candidate was compared for as long as any is."""
        return not self.stays and len(self.gains_db) >= SCHEDULE.most


class PathLearner:
    """Learns from every hop that it is given, and answers with an update where a better path is found.

    Parameters
    ----------
    profile : Profile, optional
        What the filter began with.
    remember : Path, optional
        Where to keep what was learned, as a profile for the next time. It is written after a fit and at the end, where on
        hops that came later a filter that begins with it clearly leaves less than one that begins with `profile`.

    Notes
    -----
    It keeps the last minute. Now and then it fits the loudspeaker's effects to it, replays the minute to a new path that
    has them, and then runs that path beside the one in use. Where it predicts new hops clearly better, it is the update;
    the path that it replaces runs on, and comes back where it is the better one again. The same recording teaches the same.

    Examples
    --------
    >>> import edgefilter
    >>> learner = edgefilter.PathLearner()
    >>> ego = edgefilter.EgoFilter(engine="linear", learn=learner)
    >>> learner.stats()["learned"]
    0
    """

    def __init__(self, profile: Profile | None = None, remember: Path | None = None) -> None:
        self._profile, self._remember = profile, remember
        self._counts = dict(NOTHING_LEARNED)
        self._audible_s = 0.0
        self._snapshot: tuple[PathState, int] | None = None

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins with that path."""
        self._hop, self._begin = hop, path
        self._history, self._running = HopHistory(hop), self._resumed(path)
        known = path.canceller.weights.any()
        self._response = self._running.canceller.impulse_response() if known else None
        self._compared = [CandidatePath(self._running, "the path before any learning", "unlearned", stays=True)]
        if known:
            self._compared.append(
                CandidatePath(self._fresh((), None, products=False), "a path from nothing", stays=True)
            )
        self._audible_s, self._next_s, self._peak, self._sustained = 0.0, SCHEDULE.first_s, 0.0, Sustained()
        self._snapshot = None
        self._counts = dict(NOTHING_LEARNED)

    def observe(self, hop: FilteredHop) -> PathUpdate | None:
        """Take one hop; compare, and now and then fit."""
        audible = self._audible(hop)
        self._history.append(hop, audible)
        self._running.step(hop.mic, hop.reference, hop.located, hop.past)
        left = emphasised(hop.innovation)
        for candidate in self._compared:
            if candidate.path is not self._running:
                candidate.step(hop, left, audible)
        won = [candidate for candidate in self._compared if candidate.won]
        if won:
            return self._adopt(max(won, key=lambda candidate: candidate.gain_db))
        self._compared = [candidate for candidate in self._compared if not candidate.over]
        if audible and self._audible_s >= self._next_s:
            self._next_s = min(self._next_s * SCHEDULE.factor, self._next_s + MINUTE)
            self._compared = [candidate for candidate in self._compared if candidate.stays] + self._candidates()
            with suppress(ProfileError):  # it is tried again, and told of, at the end; the sound goes on
                self._keep()
            self._snapshot = self._running.state(), self._history.count
        return None

    def stats(self) -> dict[str, object]:
        """What was learned so far."""
        return {**self._counts, "heard_s": round(self._audible_s, 2)}

    def close(self) -> None:
        """Keep what was learned, where it is worth it; raises ProfileError where the file cannot be written."""
        self._keep()

    def _audible(self, hop: FilteredHop) -> bool:
        power = float(hop.reference.dot(hop.reference))
        self._peak = max(self._sustained.step(power), SCHEDULE.fade * self._peak)
        audible = hop.located and power > AUDIBLE * self._peak
        self._audible_s += audible * self._hop / SAMPLE_RATE
        return audible

    def _adopt(self, winner: CandidatePath) -> PathUpdate:
        self._counts[winner.kind] += 1
        self._next_s = min(self._next_s, self._audible_s + RECENT_S)
        detail = f"{winner.was}: {winner.gain_db:.1f} dB less is left of the robot"
        self._compared = [candidate for candidate in self._compared if candidate.stays and candidate.was != BEFORE]
        for candidate in self._compared:
            candidate.restart()
        if all(candidate.path is not self._running for candidate in self._compared):
            self._compared.append(CandidatePath(self._running, BEFORE, "unlearned", stays=True))
        self._running = winner.path
        return PathUpdate(winner.path.state(), winner.kind, detail)

    def _candidates(self) -> list[CandidatePath]:
        """Paths that know the minute, with its loudspeaker and without; and one from nothing: the robot may stand elsewhere."""
        self._counts["rounds"] += 1
        known, fitted = self._begin.effects, self._fitted()
        short = self._audible_s < RECENT_S
        candidates = [CandidatePath(self._fresh(known, self._response), "path")]
        if any(find(name).learned for name, _ in fitted):
            candidates.append(CandidatePath(self._fresh(fitted, self._response), "loudspeaker and path"))
        for candidate in candidates:
            for _ in range(SCHEDULE.times if short else 1):
                self._history.replay(candidate.path)
        if self._response is not None or not short:
            elsewhere, recent = self._fresh(fitted, None), self._history.recent()
            for _ in range(SCHEDULE.times):
                recent.replay(elsewhere)
            candidates.append(CandidatePath(elsewhere, "another path"))
        return candidates

    def _fitted(self) -> Effects:
        """The effects of the beginning, those that can be learned as they explain the newest seconds."""
        recent, effects = self._history.recent(), self._begin.effects
        use = recent.usable()
        if use.sum() < SCHEDULE.first_s * SAMPLE_RATE / 2:
            return effects
        noise_psd = floored(periodograms(recent.signal("innovation")[use], GRID_FFT).mean(axis=0)).astype(np.float32)
        measurement = Measurement(recent.signal("reference"), recent.signal("mic"), noise_psd, use)
        path = first(self._running.canceller.impulse_response())
        for effect in EFFECTS:
            if effect.learned:
                others = tuple(entry for entry in effects if entry[0] != effect.name)
                model = EchoModel(path, tuple(entry for entry in others if find(entry[0]).stage == "source"))
                try:
                    values = model.fitted(effect.name, measurement)
                except (ArithmeticError, np.linalg.LinAlgError):  # what cannot be fitted is not learned
                    continue
                effects = others if vanishes(effect, values) else (*others, (effect.name, values))
        return effects

    def _fresh(self, effects: Effects, response: Samples | None, products: bool = True) -> EchoPath:
        """A path with those effects that starts from an impulse response, or from nothing, and has adapted to nothing."""
        begin = self._begin.canceller.adaptation
        if response is None:
            begin = replace(COLD, posterior=begin.posterior)
        adaptation = replace(begin, products=products)
        microphones = self._running.canceller.microphones
        return EchoPath(Canceller(self._hop, TAPS[1], response, adaptation, microphones=microphones), effects)

    def _keep(self) -> None:
        """Write what had been learned by the latest fit, where the hops since show that it is better to begin with."""
        if self._remember is None or self._snapshot is None:
            return
        state, count = self._snapshot
        learned = learned_profile(self._profile, self._resumed(state), self._history)
        microphones = self._running.canceller.microphones
        before = starting_path(self._profile, self._hop, microphones)
        candidate = CandidatePath(starting_path(learned, self._hop, microphones), "what was learned")
        for hop, audible in self._history.since(count):
            left = emphasised(before.step(hop.mic, hop.reference, hop.located, hop.past).innovation)
            candidate.step(hop, left, audible)
        if candidate.won:
            learned.save(self._remember)
            self._counts["remembered"] += 1

    def _resumed(self, state: PathState) -> EchoPath:
        return EchoPath.resumed(state, np.zeros(PAST, np.float32), self._hop)


def learned_profile(base: Profile | None, path: EchoPath, history: HopHistory) -> Profile:
    """The profile of a robot heard through that path, with the noise of its silences; base: keeps what a calibration alone measures."""
    canceller = path.canceller
    response = canceller.impulse_response()
    noise_psd = floored(fan_in_silences(history.signal("mic"), history.silent())[0]).astype(np.float32)
    today = datetime.datetime.now(datetime.timezone.utc).date().isoformat()
    if base is not None:
        adapted = base.with_running_responses(response, canceller.volume.gain, path.effects)
        return replace(adapted, noise_psd=noise_psd, created=today, source=LEARNED)
    array = None
    if canceller.microphones is not None:
        array = ArrayCalibration(response[1:], cross_density(history.noise()))
        response = response[0]
    echo = EchoModel(response, path.effects)
    predicted = whiten(echo.predict(history.signal("reference")), noise_psd)
    made = profile_of(echo, history.delay, noise_psd, predicted)
    return replace(made, created=today, source=LEARNED, array=array)
