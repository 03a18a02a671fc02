"""The comparisons that a report can switch between: the recording against the profile with some of the found effects."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from edgefilter.compare import Comparison, describe
from edgefilter.diagnose import Finding
from edgefilter.prepare import prepare
from edgefilter.profile import Profile
from edgefilter.types import Samples

MAX_FREE = 3
"""Up to so many effects every subset is computed; of more only those that leave out the last ones."""

Choice = tuple[bool, ...]


def choices(count: int) -> list[Choice]:
    """Which of count effects are on, for each comparison that a report holds; the one with none comes first, with all last."""
    if count <= MAX_FREE:
        return list(product((False, True), repeat=count))
    return [tuple(i < on for i in range(count)) for on in range(count + 1)]


def compare_variants(profile: Profile, findings: Sequence[Finding], recording: Samples, reference: Samples) -> dict[Choice, Comparison]:
    """For each choice of findings, recording (n,) against the profile with those effects at the values that were found."""
    prepared = prepare(profile, recording, reference)
    found = {}
    for choice in choices(len(findings)):
        model = profile.echo
        for finding, on in zip(findings, choice, strict=True):
            if on:
                model = model.with_effect(finding.effect, finding.values)
        found[choice] = describe(prepared, model.predict(prepared.measurement.reference))
    return found
