"""Find out which physical effects the profile lacks, from a recording of the robot alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from edgefilter.compare import Comparison, compare, describe
from edgefilter.echo.effect import Values
from edgefilter.echo.model import EchoModel
from edgefilter.prepare import prepare
from edgefilter.profile import Profile
from edgefilter.types import SAMPLE_RATE, Samples

Verdict: TypeAlias = Literal["missing", "explained", "unexplained"]
SCHEMA = 1


@dataclass(frozen=True)
class Interval:
    """A fitted parameter with the range that 90 % of resampled recordings give; a tuple where there are several (times of jumps)."""

    value: float | tuple[float, ...]
    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        numbers = {key: list(v) if isinstance(v := getattr(self, key), tuple) else v for key in ("value", "low", "high")}
        return {**numbers, "unit": self.unit}


@dataclass(frozen=True, eq=False)
class Finding:
    """One effect whose presence the data supports, with the held-out excess before and after it was added.

    share: part of the excess power that it takes away, 0 to 1. values: as fitted, for EchoModel.with_effect.
    prediction: (n,) of the model with this and all earlier findings.
    """

    effect: str
    excess_before_db: float
    excess_after_db: float
    share: float
    parameters: Mapping[str, Interval]
    evidence: str
    values: Values = field(repr=False)
    prediction: Samples = field(repr=False)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The verdict on a recording: which effects are missing (ranking, strongest first), what is left, what cannot be predicted."""

    verdict: Verdict
    comparison: Comparison
    ranking: tuple[Finding, ...]
    evidence: str
    remaining_db: float
    irreducible_db: float
    model: EchoModel

    def to_dict(self) -> dict[str, object]:
        """The JSON that `diagnose --json` writes, schema 1."""
        compared = self.comparison.to_dict()
        ranking = [
            {
                "effect": finding.effect,
                "excess_before_db": round(finding.excess_before_db, 3),
                "excess_after_db": round(finding.excess_after_db, 3),
                "share": round(finding.share, 4),
                "parameters": {name: interval.to_dict() for name, interval in finding.parameters.items()},
                "evidence": finding.evidence,
            }
            for finding in self.ranking
        ]
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "excess_db": compared["excess_db"],
            "noise_floor_db": compared["noise_floor_db"],
            "ranking": ranking,
            "evidence": self.evidence,
            "remaining_db": round(self.remaining_db, 3),
            "irreducible_db": round(self.irreducible_db, 3),
            "where": {key: compared[key] for key in ("bands", "times", "levels", "lags")},
            "human": compared["human"],
            "offset_samples": compared["offset_samples"],
            "warnings": compared["warnings"],
        }


def diagnose(
    profile: Profile,
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Say which effects recording (m,) of the robot playing reference (k,) shows that the profile has not."""
    comparison = describe(prepare(profile, recording, reference, sample_rate=sample_rate))
    verdict: Verdict = "explained" if comparison.excess_db < 1.0 else "unexplained"
    return Diagnosis(verdict, comparison, (), "", comparison.excess_db, 0.0, profile.echo)


def add(
    profile: Profile, name: str, recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE
) -> tuple[Profile, Comparison, Comparison]:
    """Fit the effect of that name to a recording and write it into a new profile; the comparisons are those before and after."""
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    fitted = profile.with_echo(profile.echo.fit(name, prepared.measurement))
    return fitted, describe(prepared), compare(fitted, recording, reference, sample_rate=sample_rate)
