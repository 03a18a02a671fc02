"""Whether what a recording teaches helps the running filter: fitted to the first part of it, heard on the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.compare import rounded
from edgefilter.diagnosis.joint import fit_straight
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.dsp.frames import block_power, decibels
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.echo.recording import BLOCK
from edgefilter.errors import SignalError
from edgefilter.filter.ego_filter import enhance
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

FIRST = 0.6
"""Part of the robot's voice that the proof fits to: the rest is as short as suffices to test a filter, since a fit to less
than all is worse than the one that is written."""
NEAR = 0.1
"""Share of the recording by which the cut between what is fitted and what is tested may move, either way, into a pause."""
LEAST_S = BLOCK / SAMPLE_RATE
"""Seconds of the robot alone that each part must hold: of less nothing is fitted and tested in turn."""
WORSE_DB = 0.2
"""By less ERLE than this two runs of the filter differ for no reason."""
AHEAD = SAMPLE_RATE // 10
"""Samples by which the filter hears the reference ahead of the microphone, as on a robot."""


@dataclass(frozen=True)
class Proof:
    """ERLE (dB) of the running filter, engine linear, over seconds that no fit has seen, without and with the effects.

    seconds: of the robot alone that were tested on, from start_s to the recording's end. without: of several effects,
    the ERLE with all but that one, where they make the filter worse; empty otherwise. left_before, left_after: what the
    filter gives of these seconds, (n,).
    """

    effects: tuple[str, ...]
    start_s: float
    seconds: float
    erle_before_db: float
    erle_after_db: float
    left_before: Samples = field(repr=False, compare=False)
    left_after: Samples = field(repr=False, compare=False)
    without: tuple[tuple[str, float], ...] = ()

    @property
    def worse(self) -> bool:
        """Whether the filter is better off without."""
        return self.erle_after_db < self.erle_before_db - WORSE_DB

    @property
    def culprit(self) -> str | None:
        """The effect whose removal makes the running filter best; None where there is but one, or nothing became worse."""
        return max(self.without, key=lambda entry: entry[1])[0] if self.without else None

    def to_dict(self) -> dict[str, object]:
        """All but the sound, ready for JSON."""
        told = {entry.name: rounded(getattr(self, entry.name), 3) for entry in fields(self) if entry.repr}
        return {**told, "without": rounded(dict(self.without), 3), "worse": self.worse}


class HeldOut:
    """A recording (n,) cut in two at a pause: a part to fit to, and the robot alone of the rest, for a filter that begins.

    profile: as of Recording; prepared: with it, or with one made from the recording. seconds: of the robot alone in that
    rest. Raises SignalError where either part holds less than LEAST_S of the robot.
    """

    def __init__(self, profile: Profile | None, prepared: Straightened, recording: Samples, reference: Samples) -> None:
        self._profile, self._prepared = profile, prepared
        robot = prepared.usable & prepared.active
        self.cut = _cut(prepared.prediction, robot)
        self._tested = robot[self.cut :]
        self.seconds = float(np.count_nonzero(self._tested)) / SAMPLE_RATE
        shortest = min(self.seconds, float(np.count_nonzero(robot[: self.cut])) / SAMPLE_RATE)
        if shortest < LEAST_S:
            raise SignalError(
                f"too little of the robot alone to hold seconds out and prove a fit on them: {shortest:.1f} s, expected"
                f" {LEAST_S:g} s in each part of the recording; give a longer one, or --force"
            )
        self._first = profile or self_calibrate(recording[: self.cut], reference)
        early = prepared if profile else prepare(self._first, recording, reference)
        before = np.arange(early.usable.size) < self.cut
        self._early = replace(early.fitted_to(early.fit & before), usable=early.usable & before)

    def proof(self, names: Sequence[str]) -> Proof:
        """The proof of effects, fitted to the first part as Recording.add does it: recording.prove."""
        before, after = self._left_before, self._left_with(names)
        erle_db = self.erle_db(before), self.erle_db(after)
        proof = Proof(tuple(names), self.cut / SAMPLE_RATE, self.seconds, *erle_db, before, after)
        if not proof.worse or len(names) < 2:
            return proof
        others = ((name, self._left_with([n for n in names if n != name])) for name in names)
        return replace(proof, without=tuple((name, self.erle_db(left)) for name, left in others))

    def until_kept(self, names: Sequence[str]) -> tuple[Proof, ...]:
        """The proof of all names, then without the one that does most harm, while there is one: the last names what is kept."""
        proofs = [self.proof(names)]
        while proofs[-1].worse and (culprit := proofs[-1].culprit):
            proofs.append(self.proof([name for name in proofs[-1].effects if name != culprit]))
        return tuple(proofs)

    @cached_property
    def _left_before(self) -> Samples:
        return self.left(self._profile)

    def _left_with(self, names: Sequence[str]) -> Samples:
        return self.left(with_fitted(self._first, self._early, names)[0])

    def left(self, profile: Profile | None) -> Samples:
        """What the running filter with that profile gives of the held-out seconds, (n,)."""
        said = np.pad(self._prepared.measurement.reference, (0, AHEAD))[self.cut + AHEAD :]
        return enhance(self._prepared.measurement.recording[self.cut :], said, profile, engine="linear")

    def erle_db(self, left: Samples) -> float:
        """ERLE over the seconds of the robot alone, dB."""
        heard = self._prepared.measurement.recording[self.cut :]
        before, after = (decibels(np.sum(np.square(x[self._tested], dtype=np.float64))) for x in (heard, left))
        return float(before - after)


def listed(names: str | Sequence[str]) -> tuple[str, ...]:
    """The names as a tuple without repeats; one name may be given as a text."""
    return (names,) if isinstance(names, str) else tuple(dict.fromkeys(names))


def lasts(name: str) -> bool:
    """Whether an effect holds for other seconds and changes the voice: what a proof by ERLE can speak of."""
    return not find(name).event and find(name).stage != "noise"


def with_fitted(
    profile: Profile, prepared: Straightened, names: Sequence[str]
) -> tuple[Profile, EchoModel, tuple[str, ...]]:
    """Fit these effects to the recording: the profile with them, the fitted model, and which of them the straightening compensates."""
    model, straightened = fit_straight(prepared, names) if names else (prepared.model, ())
    return profile.with_echo(profile.echo.with_effects(names, dict(model.effects))), model, straightened


def _cut(prediction: Samples, robot: NDArray[np.bool_]) -> int:
    """The middle of the quietest fifth of a second near where FIRST of the robot's voice is over."""
    spoken = np.cumsum(robot)
    middle = int(np.searchsorted(spoken, FIRST * spoken[-1])) if spoken.size else 0
    near, block = round(NEAR * robot.size), SAMPLE_RATE // 5
    start = max(middle - near, 0)
    part = prediction[start : middle + near]
    return start + int(np.argmin(block_power(part, block))) * block + block // 2 if part.size >= block else middle
