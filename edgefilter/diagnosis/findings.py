"""What a search has found, of each effect by itself: its part of the excess, its parameters and how well they are known."""

from __future__ import annotations

from collections.abc import Mapping

from edgefilter.diagnosis.ordinary import p_value
from edgefilter.diagnosis.result import Finding, Interval
from edgefilter.diagnosis.straightened import share_of
from edgefilter.diagnosis.trials import Found, less
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel

HELD = "; the profile holds this effect with other values"
"""Behind the evidence of an effect that has changed."""


def findings_of(found: Found, intervals: Mapping[str, Mapping[str, Interval]]) -> tuple[Finding, ...]:
    """The findings, the effect without which most is left first; intervals: of their parameters, by effect.

    Each has the excess over the fan before and after its effect was added. A change of the fan's noise comes first only where it
    explains more than all other findings together.
    """
    findings, before = [], found.base.excess_db
    for step in found.steps:
        without_db = found.recording.of(less(found.start, found.model, step.name)).level_db
        after = found.final.excess_db if step is found.steps[-1] else step.score.excess_db
        otherwise = f"with {step.name} the held-out residual falls by {step.gain_db:.2f} dB"
        findings.append(
            Finding(
                effect=step.name,
                family=find(step.name).family,
                p_value=min(step.p_value, p_value(step.name, without_db - found.final.level_db)),
                excess_before_db=before,
                excess_after_db=after,
                share=max(share_of(found.base.excess_db, after) - share_of(found.base.excess_db, before), 0.0),
                parameters=intervals.get(step.name, {}),
                evidence=evidence_of(step.name, step.values, found.start, otherwise),
                values=step.values,
                prediction=step.score.prediction,
                like=found.like.get(step.name),
            )
        )
        before = after
    voice, noise = ([f for f in findings if (find(f.effect).stage == "noise") is fan] for fan in (False, True))
    first = noise and sum(f.share for f in noise) > sum(f.share for f in voice)
    return tuple((*noise, *voice) if first else (*voice, *noise))


def evidence_of(name: str, values: Values, start: EchoModel, otherwise: str) -> str:
    """What an effect says of its values, or otherwise; and that the start has it already, where it has."""
    held = name in dict(start.effects)
    if held and vanishes(find(name), values):
        return "the recording shows nothing of it, and the profile holds it"
    said = find(name).sentence(values) or otherwise.removesuffix(HELD)
    return said + (HELD if held else "")
