"""What the aligner tells of itself: how sure it is of a lag, and in which state it is once it has found one."""

import numpy as np
import pytest

from edgefilter.alignment.aligner import Aligner
from tests.alignment.scene import fan, hear, room, run, utterances


def found(noise: float):
    """The hop in which an utterance's lag is found in a fan of that rms level; the voice has about 0.016."""
    rng = np.random.default_rng(1)
    ref, _ = utterances(rng, [3.0], [1.0])
    mic, _ = hear(ref, [(0, 3000)], room(rng, 0.3))
    hops = run(Aligner(256), mic + fan(rng, ref.size, noise), ref)
    return next(hop for hop in hops if hop.realigned)


def test_a_lag_that_was_found_in_loud_noise_is_told_with_less_confidence():
    quiet, loud = found(0.002), found(0.4)
    assert abs(quiet.delay - loud.delay) < 16  # both are right, within a millisecond
    assert 0.99 < loud.confidence < quiet.confidence < 1.0  # odds of 100 are needed to believe it


@pytest.mark.parametrize("noise", [0.002, 0.1])
def test_the_reference_is_followed_from_the_hop_on_in_which_its_lag_was_found(noise):
    assert found(noise).state == "locked"
