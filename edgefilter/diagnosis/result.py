"""What a diagnosis says: effects with their parameters and evidence, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from edgefilter.diagnosis.compare import Comparison, rounded
from edgefilter.diagnosis.independence import Independence
from edgefilter.diagnosis.laws import Law
from edgefilter.diagnosis.trials import Reading
from edgefilter.echo.effect import Family
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.types import Array, Samples

if TYPE_CHECKING:
    from edgefilter.diagnosis.proof import Proof

Verdict: TypeAlias = Literal["missing", "explained", "unexplained"]
Fate: TypeAlias = Literal[
    "named", "explained by another", "explains too little", "below its bar", "failed its proof", "not fitted"
]
"""What became of an effect that was tried; only where a proof in the running filter was asked for can it have failed one."""
Source: TypeAlias = Literal["jacobian", "thirds", "at its bound", "none"]
"""Of a standard error: the prediction's derivatives, fits to a third of the recording each, or why there is none."""


@dataclass(frozen=True)
class Interval:
    """A fitted parameter with the range that 90 % of resampled recordings give; tuples of several (times of jumps)."""

    value: float | tuple[float, ...]
    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    unit: str

    @classmethod
    def of(cls, value: float | Array, low: float | Array, high: float | Array, unit: str) -> Interval:
        """From numbers, or arrays (k,)."""
        plain = float if np.ndim(value) == 0 else lambda array: tuple(map(float, array))
        return cls(plain(value), plain(low), plain(high), unit)

    def at(self, value: float | Array) -> Interval:
        """The same range around another value; as it is where there are not as many."""
        if np.shape(value) != np.shape(self.value):
            return self
        low, high = (np.asarray(value) + end - self.value for end in (self.low, self.high))
        return Interval.of(value, low, high, self.unit)


@dataclass(frozen=True, eq=False)
class Finding:
    """One effect whose presence the data supports, with the held-out excess before and after it was added.

    p_value: of what it explains, by itself or beside the others (diagnosis/ordinary.py). share: part of the excess power
    that it takes away, 0 to 1. values: as fitted, for EchoModel.with_effect. prediction: (n,) of the model with this and
    all earlier findings. like: where the effect is the free law of a family, the listed effect that it is known by.
    """

    effect: str
    family: Family
    p_value: float
    excess_before_db: float
    excess_after_db: float
    share: float
    parameters: Mapping[str, Interval]
    evidence: str
    values: Values = field(repr=False)
    prediction: Samples = field(repr=False)
    like: Reading | None = None

    @property
    def name(self) -> str:
        """Name in the list of effects: that of the effect itself, of a free law that of the named effect which it replaced."""
        return self.like.name if self.like else self.effect


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect that was tried, whatever came of it; why: in words.

    gain_db: by which it lowers the held-out level beside nothing else; beside_db: beside the others that were found;
    None where it was not fitted there. rank: by the first of them that is known, from 1.
    """

    effect: str
    verdict: Fate
    why: str
    gain_db: float | None = None
    beside_db: float | None = None
    rank: int | None = None


@dataclass(frozen=True)
class Known:
    """One number of a finding, by parameter and index, with its standard error; source: where that is from, or why none."""

    effect: str
    parameter: str
    index: int
    value: float
    unit: str
    error: float | None
    source: Source

    @property
    def label(self) -> str:
        """As effect.parameter, with the index where it is not the first."""
        return f"{self.effect}.{self.parameter}" + (f"[{self.index}]" if self.index else "")


@dataclass(frozen=True)
class Precision:
    """Uncertainty of the fitted parameters, and the correlations of their errors: (label, label, correlation), the strongest first."""

    numbers: tuple[Known, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()

    def at(self, values: Mapping[str, Values]) -> Precision:
        """The same of other values, by effect."""
        here = [(known, np.ravel(values[known.effect][known.parameter])) for known in self.numbers]
        numbers = (replace(known, value=float(found[known.index])) for known, found in here if known.index < found.size)
        return replace(self, numbers=tuple(numbers))

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        return {"numbers": [asdict(known) for known in self.numbers], "correlations": rounded(self.correlations)}


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The verdict on a recording: which effects are missing (ranking, strongest first), what is left.

    irreducible_db: what no waveform predicts, over the fan alone. tried: all effects that were tried. independence: of
    what is left with all that was found. precision: of the found numbers. advice: what to record to tell candidates
    apart that explain nearly the same. proof: of what was found, in the running filter, where it was asked for;
    unproven: why there is none. written: the comparison with the profile that was written of it, whose figures it then
    has. law: the free one that explains much more of it than what is named.
    """

    verdict: Verdict
    comparison: Comparison
    ranking: tuple[Finding, ...]
    evidence: str
    remaining_db: float
    irreducible_db: float
    model: EchoModel
    tried: tuple[Candidate, ...] = ()
    independence: Independence | None = None
    precision: Precision = Precision()
    advice: tuple[str, ...] = ()
    proof: Proof | None = None
    unproven: str = ""
    written: Comparison | None = None
    law: Law | None = None

    def to_dict(self) -> dict[str, object]:
        """The JSON that `diagnose --json` writes, schema 2."""
        compared = self.comparison.to_dict()
        ranking = [
            {
                "effect": finding.effect,
                "family": finding.family,
                "p_value": finding.p_value,
                "excess_before_db": round(finding.excess_before_db, 3),
                "excess_after_db": round(finding.excess_after_db, 3),
                "share": round(finding.share, 4),
                "parameters": {name: asdict(interval) for name, interval in finding.parameters.items()},
                "evidence": finding.evidence,
                **({"like": finding.like.name, "like_share": round(finding.like.share, 4)} if finding.like else {}),
            }
            for finding in self.ranking
        ]
        return {
            "schema": 2,
            "verdict": self.verdict,
            **{key: compared[key] for key in ("excess_db", "noise_floor_db")},
            "ranking": ranking,
            "evidence": self.evidence,
            "remaining_db": round(self.remaining_db, 3),
            "irreducible_db": round(self.irreducible_db, 3),
            "where": {key: compared[key] for key in ("bands", "times", "levels", "lags")},
            **{key: compared[key] for key in ("human", "offset_samples", "warnings")},
            "tried": [rounded(asdict(candidate)) for candidate in self.tried],
            "independence": {"of_profile": compared["independence"], "of_findings": _dict_of(self.independence)},
            "precision": self.precision.to_dict(),
            "advice": list(self.advice),
            "proof": _dict_of(self.proof),
            "unproven": self.unproven,
            "law": _dict_of(self.law),
        }


def _dict_of(part: Independence | Proof | Law | None) -> dict[str, object] | None:
    return part.to_dict() if part else None


def in_order(ranking: Sequence[Finding]) -> list[Finding]:
    """The findings as one was added after the other: each starts where the one before it ended."""
    return sorted(ranking, key=lambda finding: -finding.excess_before_db)
