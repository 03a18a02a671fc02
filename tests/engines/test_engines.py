"""Every engine through the conformance suite, inside the real stream."""

from pathlib import Path

import numpy as np
import pytest

from edgefilter import engines
from edgefilter.errors import SignalError, UsageError
from edgefilter.filter.ego_filter import EgoFilter, enhance
from edgefilter.filter.stream import Stream, step
from edgefilter.types import Frame, Output
from tests import conformance
from tests.conformance import robot

DATA = Path(__file__).parents[1] / "data"
MODELS = {"crnn": DATA / "crnn.onnx", "paper-crnn": DATA / "paper_crnn.onnx"}
"""Networks of the smallest size; tests/data/make_models.py makes them."""
CHECKS = {"paper-crnn": conformance.CLIP_CHECKS}
CASES = [(name, check) for name in engines.ENGINES for check in CHECKS.get(name, conformance.CHECKS)]


@pytest.mark.parametrize("name, check", CASES, ids=lambda value: getattr(value, "__name__", value))
def test_engine_conforms(name, check):
    profile = robot()
    check(lambda: Stream(engines.create(name, profile, model=MODELS.get(name)), profile))


def test_conformance_has_its_checks():
    assert len(conformance.CHECKS) == 9 and len(conformance.CLIP_CHECKS) == 8


def test_bypass_returns_its_input_from_the_first_sample():
    mic, ref = conformance.conversation()
    # 1e-6: float32 rounding of an FFT, its inverse and two windows, on samples below 1
    np.testing.assert_allclose(enhance(mic, ref, engine="bypass"), mic, atol=1e-6)


def test_an_unknown_engine_names_the_known_ones():
    with pytest.raises(UsageError, match="unknown engine 'crn'.*linear.*bypass"):
        EgoFilter(engine="crn")


def test_paper_ss_asks_for_a_profile():
    with pytest.raises(UsageError, match="paper-ss needs.*--profile"):
        EgoFilter(engine="paper-ss")


def test_messages_about_the_linear_stage_name_every_engine_that_has_one():
    classes = {name: type(engines.create(name, robot(), model=MODELS.get(name))) for name in engines.ENGINES}
    assert {name for name, made in classes.items() if made.front == "full"} == set(engines.HAVE_LINEAR_STAGE)
    with pytest.raises(SignalError, match=r"\(crnn, ss, linear\)"):
        EgoFilter(engine="bypass").adapted_profile()


def test_nobody_speaks_while_the_robot_may_arrive_at_any_lag():
    class Sure(engines.linear.Bypass):
        def step(self, frame, state):
            return Output(frame.error, 1.0), None

    zeros, some = np.zeros(257, np.float32), np.full(257, 0.5 + 0j, np.complex64)
    frame = Frame(some, some, some, some, zeros + 1e-4, zeros)
    assert step(Sure(), frame, None)[0].speech_probability == 1.0
    output, _ = step(Sure(), frame._replace(at_any_lag=True), None)
    assert output.speech_probability == 0.0 and np.abs(output.spectrum).max() < 0.02
