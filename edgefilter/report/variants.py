"""The comparisons that a report can switch between: the recording against the profile with some of the found effects."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from edgefilter.diagnosis.compare import Comparison, describe
from edgefilter.diagnosis.diagnose import Finding
from edgefilter.diagnosis.prepare import Prepared, prepare
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import Profile
from edgefilter.types import Samples

MAX_FREE = 3
"""Up to so many effects every subset is computed; of more only those that leave out the last ones."""

Choice = tuple[bool, ...]


def choices(count: int) -> list[Choice]:
    """Which of count effects are on, for each comparison that a report holds.

    The one with none comes first, with all last.
    """
    if count <= MAX_FREE:
        return list(product((False, True), repeat=count))
    return [tuple(i < on for i in range(count)) for on in range(count + 1)]


def compare_variants(
    profile: Profile, model: EchoModel, findings: Sequence[Finding], recording: Samples, reference: Samples
) -> dict[Choice, Comparison]:
    """For each choice of findings, recording (n,) against model, which has them all, without those that are off.

    The excess of each is the diagnosis's; where it is, is shown for all samples.
    """
    prepared = prepare(profile, recording, reference)
    found = {}
    for choice in choices(len(findings)):
        chosen, partial = [], model
        for finding, on in zip(findings, choice, strict=True):
            if on:
                chosen.append(finding)
            else:
                partial = partial.without_effect(finding.effect)
        found[choice] = describe(_with_noise(prepared, chosen), partial)
    return found


def _with_noise(prepared: Prepared, findings: Sequence[Finding]) -> Prepared:
    """The same recording, the noise to be expected being that with the chosen effects on the fan."""
    psd = prepared.noise_psd
    for finding in findings:
        effect = find(finding.effect)
        psd = effect.noise_psd(complete(effect, finding.values), psd)
    return prepared.behind(psd)
