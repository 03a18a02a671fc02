"""A diagnosis of the first part of a recording, proven on the rest: no name with which the running filter is worse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.proof import HeldOut, Proof, lasts
from edgefilter.diagnosis.result import Candidate, Diagnosis
from edgefilter.errors import SignalError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def diagnose_proven(
    profile: Profile,
    recording: Samples,
    reference: Samples,
    *,
    progress: Callable[[str], None] | None = None,
    criteria: Criteria | None = None,
) -> Diagnosis:
    """`diagnose` of the first part of a recording, without the effects that the running filter contradicts on the rest.

    Parameters
    ----------
    profile : Profile
        What is known of the robot; not one made from this recording, which has heard the seconds of the proof.
    recording, reference : ndarray of float, shape (m,) and (n,)
        As of `diagnose`, at 16 kHz.
    progress, criteria
        As of `diagnose`.

    Returns
    -------
    Diagnosis
        With the proof of all lasting effects on the voice together, or why there is none.

    Raises
    ------
    SignalError
        Where the recording does not contain the reference.

    Notes
    -----
    The first three fifths of the robot's voice are diagnosed, the running filter then takes the rest (`prove`). Where it
    is worse with what was found, the diagnosis is made anew without the effect that does most harm, until it is not:
    another one may take its place. Not proven are events, which do not come again, and changes of the stationary noise.
    Where a recording is too short to be cut, all of it is diagnosed and nothing proven.

    Examples
    --------
    The robot's volume was turned down by 1.9 dB.

    >>> import numpy as np
    >>> from edgefilter import calibrate, generate_sweep
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> found = diagnose_proven(profile, 0.4 * np.roll(said, 300) + fan(said.size), said)
    >>> found.ranking[0].effect, found.proof.worse
    ('playback_gain', False)
    """
    disproved: dict[str, Proof] = {}
    held, too_short = None, ""
    try:
        held = HeldOut(profile, recording, reference)
    except SignalError as error:
        too_short = str(error)
    stop = held.cut if held else recording.size
    while True:
        found = diagnose(
            profile, recording[:stop], reference[:stop], progress=progress, criteria=criteria, without=disproved
        )
        names = tuple(finding.effect for finding in found.ranking if lasts(finding.effect))
        if not held or not names:
            return _told(found, disproved, unproven=too_short if names else "nothing lasting was found")
        if progress:
            progress("the running filter without and with what was found")
        proof = held.proof(names)
        if not proof.worse:
            return _told(found, disproved, proof)
        disproved[proof.culprit or names[0]] = proof


def _told(found: Diagnosis, disproved: dict[str, Proof], proof: Proof | None = None, unproven: str = "") -> Diagnosis:
    """The diagnosis with its proof and a row for each effect that failed one."""
    rows = tuple(
        Candidate(
            name,
            "failed its proof",
            f"with {' and '.join(failed.effects)} the running filter is worse on {failed.seconds:.1f} s that the fit has"
            f" not seen: ERLE {failed.erle_before_db:.1f} dB without, {failed.erle_after_db:.1f} dB with",
        )
        for name, failed in disproved.items()
    )
    return replace(found, tried=(*found.tried, *rows), proof=proof, unproven=unproven)
