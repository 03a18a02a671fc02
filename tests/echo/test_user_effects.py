"""Effects of the user's own: a good file is one effect more, each kind of broken file is one line that says what is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from edgefilter import enhance
from edgefilter.diagnosis.prepare import prepare
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.running import SourceChain, VoiceChain, reach, stream_form
from edgefilter.echo.user_effects import load_effect
from edgefilter.errors import UsageError
from tests.diagnosis.robot_scene import profile, record, voice
from tests.echo.own_effect import documented_file

GOOD = """
import numpy as np
from edgefilter.echo.effect import Parameter

class Tilt:
    name = "tilt"
    stage = "path"
    parameters = (Parameter("amount", "1", 0.0, -1.0, 1.0),)

    def apply(self, x, values, sample_rate):
        return (x + values["amount"] * np.append(0, x[:-1])).astype(np.float32)

    def fit(self, measurement, model):
        return {"amount": 0.5}
"""


@pytest.fixture
def write(tmp_path):
    def put(text: str, name: str = "mine.py") -> Path:
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return put


def test_a_good_file_is_one_effect_more_and_loads_once(write):
    path = write(GOOD)
    assert load_effect(path) == "tilt" == load_effect(path)
    assert "tilt" in names()
    x = voice(2.0)
    model = profile().echo
    tilted = model.with_effect("tilt", {"amount": 0.5}).predict(x)
    plain = model.predict(x)
    np.testing.assert_allclose(tilted[1:], plain[1:] + 0.5 * plain[:-1], atol=1e-6)  # rounding of float32
    assert model.fit("tilt", Measurement(x, tilted)).effects == (("tilt", {"amount": 0.5}),)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("class Tilt:", "class Tilt", "line 5 is not Python"),
        ("import numpy as np", "import nunpy", "stops with ModuleNotFoundError: No module named 'nunpy'"),
        ("import numpy as np", "raise SystemExit(3)", "stops with SystemExit: 3"),
        ("class Tilt:", "class Other:\n    def apply(self): ...\nclass Tilt:", "found Other, Tilt"),
        ("def apply", "def transform", "found none"),
        ('stage = "path"', "", "class Tilt lacks stage"),
        ('name = "tilt"', 'name = "clock_drift"', "'clock_drift' exists already"),
        ('name = "tilt"', 'name = "my tilt"', "name is 'my tilt'"),
        ('stage = "path"', 'stage = "room"', "stage is 'room', expected one of source"),
        ('(Parameter("amount", "1", 0.0, -1.0, 1.0),)', '("amount",)', "not a tuple of Parameter"),
        ("0.0, -1.0, 1.0", "3.0, -1.0, 1.0", "neutral amount=3 is outside"),
        ("0.0, -1.0, 1.0", "0.5, -1.0, 1.0", "changes the signal at the neutral values"),
        (".astype(np.float32)", "", "float64 of shape (4000,), expected finite float32"),
        (
            "return (x +",
            "x[0] = 0; return (x +",
            "apply stops at line 11 with ValueError: assignment destination is read-only",
        ),
        ("parameters = (P", "def __init__(self, depth): ...\n    parameters = (P", "Tilt() stops with TypeError"),
    ],
)
def test_a_broken_file_is_one_line_and_registers_nothing(write, old, new, words):
    before = names()
    assert old in GOOD
    path = write(GOOD.replace(old, new))
    with pytest.raises(UsageError, match=re.escape(words)) as caught:
        load_effect(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert names() == before


def test_a_file_that_is_not_there_or_not_python_is_one_line(tmp_path, write):
    with pytest.raises(UsageError, match="no such file"):
        load_effect(tmp_path / "none.py")
    with pytest.raises(UsageError, match="ends in .py"):
        load_effect(write(GOOD, "mine.txt"))


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ("None", "fit gives NoneType"),
        ('{"much": 1.0}', "no parameter 'much'"),
        ('{"amount": 7.0}', "expected -1 to 1"),
        ("1 / 0", "fit stops at line 14 with ZeroDivisionError"),
    ],
)
def test_a_fit_that_fails_is_one_line(write, result, words):
    load_effect(write(GOOD.replace('{"amount": 0.5}', result)))
    x = voice(1.0)
    with pytest.raises(UsageError, match=words):
        profile().echo.fit("tilt", Measurement(x, x))


NOISY = """
import numpy as np
from edgefilter.echo.effect import Effect, Parameter

class Hiss(Effect):
    name = "hiss"
    stage = "noise"
    parameters = (Parameter("power", "full scale^2", 0.0, 0.0, 1.0),)

    def fit(self, measurement, model):
        return {"power": 1e-4}

    def variance(self, reference, values, sample_rate):
        return np.full(reference.size, values["power"])

    def colour(self, values):
        return np.full(601, 1 / 8000)
"""


def test_a_noise_effect_of_the_users_own_does_not_crash_the_model(write):
    load_effect(write(NOISY))
    x = voice(1.0)
    ((variance, colour),) = profile().echo.with_effect("hiss", {"power": 1e-3}).unpredictable(x)
    assert variance == pytest.approx(1e-3) and colour.sum() * 8000 / 601 == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("hook", "words"),
    [
        (
            "def variance(self, reference, values, sample_rate):\n        return 1 / 0",
            "variance stops at line 14 with ZeroDivisionError",
        ),
        (
            "def variance(self, reference, values, sample_rate):\n        return values",
            "variance gives dict, expected finite numbers of shape (16000,)",
        ),
        (
            "def colour(self, values):\n        return np.ones(7)",
            "colour gives float64 of shape (7,), expected finite numbers of shape (601,)",
        ),
    ],
)
def test_a_noise_hook_that_fails_is_one_line(write, hook, words):
    before, after = NOISY.split("    def variance")
    load_effect(
        write(f"{before}    {hook}\n" if "variance" in hook else f"{before}    def variance{after}\n    {hook}\n")
    )
    with pytest.raises(UsageError, match=re.escape(words)):
        profile().echo.with_effect("hiss", {"power": 1e-3}).unpredictable(voice(1.0))


def test_what_a_users_class_says_of_itself_is_kept(write):
    told = "    memory, flexible, complexity, title = 0, True, 1, 'a tilt'\n"
    load_effect(write(GOOD.replace("    def apply", told + "\n    def apply")))
    tilt = find("tilt")
    assert (tilt.memory, tilt.flexible, tilt.complexity, tilt.title) == (0, True, 1, "a tilt")
    assert tilt.sentence({"amount": 1.0}) == ""


@pytest.mark.parametrize(
    ("said", "follows"),
    [
        ("stage, event = 'microphone', True", "scales_fan"),
        ("stage, family = 'microphone', 'dynamics'", "shows_in_silence"),
        ("stage, family = 'source', 'static nonlinearity'", "learned"),
        ("stage = 'microphone'", ""),
    ],
)
def test_what_follows_from_the_kind_of_a_users_effect(write, said, follows):
    load_effect(write(GOOD.replace('stage = "path"', said)))
    marks = ("scales_fan", "shows_in_silence", "learned")
    assert [mark for mark in marks if getattr(find("tilt"), mark)] == [follows] * bool(follows)


def test_the_documented_effect_finds_its_own_parameters(tmp_path):
    load_effect(documented_file(tmp_path))
    x, robot = voice(8.0), profile()
    true = {"rate_hz": 23.0, "cosine": 0.12, "sine": -0.2}
    prepared = prepare(robot, record(x, robot.echo.with_effect("blade_chop", true)), x)
    found = find("blade_chop").fit(prepared.measurement, robot.echo)
    assert found["rate_hz"] == pytest.approx(23.0, abs=1 / 32)  # the grid's step for 8 s
    assert np.hypot(found["cosine"], found["sine"]) == pytest.approx(
        np.hypot(0.12, 0.2), rel=0.05
    )  # 8 s of a voice with pauses


@pytest.mark.slow
def test_the_documented_effect_lowers_what_the_running_filter_leaves(tmp_path):
    load_effect(documented_file(tmp_path))
    x, robot = voice(12.0), profile()
    fitted = {"rate_hz": 23.0, "cosine": 0.12, "sine": -0.2}
    turned = {"rate_hz": 23.0, "cosine": 0.2, "sine": 0.12}  # another start: the blades stand elsewhere
    heard = record(x, robot.echo.with_effect("blade_chop", turned))
    knowing = robot.with_echo(robot.echo.with_effect("blade_chop", fitted))
    left = [enhance(heard, x, known, engine="linear")[4 * 16000 :] for known in (robot, knowing)]
    without, with_it = (10 * np.log10(np.mean(rest.astype(float) ** 2)) for rest in left)
    assert with_it < without - 6  # as docs/own_effect.md says
    assert reach(find("blade_chop"), fitted) == ""


def test_a_path_effect_that_is_no_filter_is_applied_to_the_voice_and_not_to_the_impulse_response(write):
    load_effect(write(GOOD.replace("np.append(0, x[:-1])", "x * np.abs(x)")))
    robot = profile().echo
    bent = robot.with_effect("tilt", {"amount": 0.5})
    assert bent.running_response() is robot.impulse_response
    x = voice(0.5)
    np.testing.assert_array_equal(VoiceChain(bent.effects)(x, x), (x + 0.5 * x * np.abs(x)).astype(np.float32))
    assert bent.with_running_response(robot.impulse_response).effects == bent.effects


def test_a_path_effect_that_is_a_filter_goes_into_the_impulse_response(write):
    load_effect(write(GOOD))
    robot = profile().echo
    tilted = robot.with_effect("tilt", {"amount": 0.5})
    before, after = robot.impulse_response, tilted.running_response()
    np.testing.assert_allclose(after[1 : before.size], before[1:] + 0.5 * before[:-1], atol=1e-6)  # float32
    assert not VoiceChain(tilted.effects) and tilted.with_running_response(after).effects == ()


def test_a_source_effect_without_memory_runs_on_the_least_past_that_gives_the_same(write):
    echo = "np.concatenate((np.zeros(200, np.float32), x))[: x.size]"
    load_effect(write(GOOD.replace('"path"', '"source"').replace("np.append(0, x[:-1])", f"np.abs({echo})")))
    x, bent = voice(1.0), profile().echo.with_effect("tilt", {"amount": 0.5})
    source = SourceChain(bent.effects)
    hops = np.concatenate([source(x[at : at + 256]) for at in range(0, x.size - 255, 256)])
    np.testing.assert_array_equal(hops, find("tilt").apply(x, {"amount": 0.5}, 16000)[: hops.size])


def test_an_effect_that_cannot_run_says_so(write):
    load_effect(write(GOOD.replace("np.append(0, x[:-1])", "x * np.sin(np.arange(x.size) / 1000)")))
    assert stream_form(find("tilt"), {"amount": 0.5}) is None
    assert "the running filter ignores it" in reach(find("tilt"), {"amount": 0.5})


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ("1 / 0", "run stops at line 17 with ZeroDivisionError"),
        ("3", "run gives int, expected a callable (x, heard) -> samples, or None"),
        ("lambda x, heard: x[:7]", "gives float32 of shape (7,), expected finite float32 of shape (16000,)"),
        ("lambda x, heard: nothing * x", "stops at line 17 with NameError"),
    ],
)
def test_a_run_that_fails_is_one_line(write, result, words):
    odd = GOOD.replace("np.append(0, x[:-1])", "np.abs(x)")
    load_effect(write(f"{odd}\n    def run(self, values, sample_rate):\n        return {result}\n"))
    with pytest.raises(UsageError, match=re.escape(words)):
        VoiceChain([("tilt", {"amount": 0.5})])(voice(1.0), voice(1.0))
