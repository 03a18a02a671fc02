"""What a diagnosis says: effects with their parameters and evidence, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from edgefilter.diagnosis.compare import Comparison
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.types import Samples

Verdict: TypeAlias = Literal["missing", "explained", "unexplained"]
SCHEMA = 1


@dataclass(frozen=True)
class Interval:
    """A fitted parameter with the range that 90 % of resampled recordings give.

    A tuple where there are several (times of jumps).
    """

    value: float | tuple[float, ...]
    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    unit: str

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        numbers = {
            key: list(v) if isinstance(v := getattr(self, key), tuple) else v for key in ("value", "low", "high")
        }
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
