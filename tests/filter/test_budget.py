"""The measured choice: best first, the first that fits, remembered for this machine.

And honest words where nothing fits.
"""

import json
import os
import time
from itertools import islice
from pathlib import Path

import numpy as np
import platformdirs
import pytest
from platformdirs.macos import MacOS
from platformdirs.unix import Unix
from platformdirs.windows import Windows

from edgefilter.echo.model import EchoModel
from edgefilter.engines.linear import Bypass
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import UsageError
from edgefilter.filter import budget
from edgefilter.filter.budget import Figures, choose, fits, held_to, measure, pace, scene, timings
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from tests.program import demo, here

DEMO = budget.DEMO
SMALL = Path(__file__).parents[1] / "data/crnn.onnx"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    return timings().parent


@pytest.fixture
def measured(monkeypatch):
    """Engines as slow as this says, p99 in ms, a list for one time after another; and those that were measured."""
    speeds = {"crnn": 7.0, "ss": 6.0, "linear": 2.0, "bypass": 0.1}
    asked = []

    def pretend(engine, profile):
        asked.append(engine.name)
        model, p99 = engine.model.sha256 if engine.name == "crnn" else "", speeds[engine.name]
        if isinstance(p99, list):
            p99 = p99.pop(0)
        return Figures(engine.name, model, 16.0, 300, p99 < 40.0, 0.6 * p99, 0.8 * p99, p99, 2 * p99)

    monkeypatch.setattr(budget, "measure", pretend)
    return speeds, asked


LADDER = ("ss", "linear", "bypass")


@pytest.mark.parametrize(
    ("budget_ms", "engine", "asked"),
    [(8.0, "ss", ["ss"]), (6.0, "ss", ["ss"]), (5.9, "linear", ["ss", "linear"]), (1.0, "bypass", list(LADDER))],
)
def test_the_best_engine_that_fits_is_taken_and_no_further_one_is_measured(measured, budget_ms, engine, asked):
    choice = choose(budget_ms, candidates=LADDER)
    assert (choice.engine, choice.fits, list(dict.fromkeys(measured[1]))) == (engine, True, asked)
    assert choice.to_dict()["figures"][-1]["paced_p99_ms"] <= budget_ms
    assert f"within {budget_ms:g} ms" in choice.reason and f"{choice.figures[-1].paced_p99_ms:.1f} ms" in choice.reason
    for beaten in asked[:-1]:
        assert f"{beaten} needs {measured[0][beaten]:.1f} ms" in choice.reason
    json.dumps(choice.to_dict())


def test_a_passing_load_does_not_cost_the_best_engine(measured):
    speeds, asked = measured
    speeds["ss"] = [30.0, 5.0]
    choice = choose(8.0, candidates=LADDER)
    assert (choice.engine, choice.figures[-1].paced_p99_ms, asked) == ("ss", 5.0, ["ss", "ss"])


def test_nothing_fits_takes_the_cheapest_and_says_what_would_help(measured):
    choice = choose(0.05, candidates=("ss", "linear"))
    assert (choice.engine, choice.fits) == ("linear", False)
    for words in ("no engine keeps to 0.05 ms", "--budget-ms 2", "free core"):
        assert words in choice.reason and "\n" not in choice.reason


def test_an_engine_that_cannot_keep_up_never_fits(measured):
    measured[0].update(ss=50.0, linear=40.0)
    choice = choose(1000.0, candidates=("ss", "linear"))
    assert not choice.fits and choice.engine == "linear" and "faster processor" in choice.reason


def test_no_budget_is_proposed_that_is_longer_than_a_hop(measured):
    measured[0].update(ss=30.0, linear=20.0)
    choice = choose(1.0, candidates=("ss", "linear"))
    assert "faster processor" in choice.reason and "--budget-ms" not in choice.reason


def test_an_engine_that_cannot_be_made_is_skipped_and_named(measured):
    choice = choose(8.0, candidates=("paper-ss", "linear"))
    assert choice.engine == "linear" and list(choice.skipped) == ["paper-ss"]
    assert "paper-ss cannot be used" in choice.reason
    with pytest.raises(UsageError, match="no engine can be made: paper-ss"):
        choose(8.0, candidates=("paper-ss",))


def test_figures_are_remembered_for_the_same_path_only(measured):
    _, asked = measured
    profile = Profile.load(DEMO / "profile.npz")
    first = choose(8.0, profile, LADDER)
    again = choose(8.0, profile, LADDER)
    assert asked == ["ss"] and not first.remembered and again.remembered and again.figures == first.figures
    assert "--remeasure" in again.reason
    assert choose(3.0, profile, LADDER).engine == "linear" and asked == ["ss", "linear"]  # only what is missing
    assert choose(3.0, profile, LADDER).remembered
    longer = profile.with_echo(EchoModel(np.pad(profile.echo.impulse_response, (0, 256))))
    choose(8.0, longer, LADDER)
    choose(8.0, None, LADDER)
    assert asked == ["ss", "linear", "ss", "ss"]
    budget.forget()
    assert not choose(8.0, profile, LADDER).remembered and asked[-1] == "ss"


def test_another_machine_or_version_is_measured_again(measured, monkeypatch):
    choose(8.0, candidates=LADDER)
    for name, other in (("processor", lambda: "another processor"), ("version", lambda package: "99")):
        with monkeypatch.context() as changed:
            changed.setattr(budget, name, other)
            assert not choose(8.0, candidates=LADDER).remembered, name
    assert choose(8.0, candidates=LADDER).remembered


def test_another_model_file_is_measured_again(measured, monkeypatch, tmp_path):
    """Its bytes count, not its name."""
    file, content = tmp_path / "model.onnx", SMALL.read_bytes()
    monkeypatch.setenv("EDGEFILTER_CRNN", str(file))
    for written in (content, content.replace(b"pytorch", b"pytorc2")):
        file.write_bytes(written)
        assert not choose(8.0, candidates=("crnn",)).remembered and choose(8.0, candidates=("crnn",)).remembered


DAMAGED = {"": "not JSON", "{": "not JSON", "[]": "JSON list", "{}": None, '{"x": 3}': None, "[" * 9999: "not JSON"}


@pytest.mark.parametrize(("text", "why"), DAMAGED.items(), ids=range(len(DAMAGED)))
def test_a_damaged_cache_is_measured_again(measured, cache, text, why):
    cache.mkdir(parents=True)
    timings().write_text(text)
    said = []
    assert choose(8.0, candidates=LADDER, say=said.append).engine == "ss" and choose(8.0, candidates=LADDER).remembered
    told = [line for line in said if "are not used" in line]
    assert len(told) == (why is not None)
    assert all(why in line and str(timings()) in line for line in told)


def test_an_old_layout_in_the_cache_is_measured_again(measured, cache):
    choose(8.0, candidates=LADDER)
    file = timings()
    file.write_text(file.read_text().replace("paced_p99_ms", "p99"))
    said = []
    assert not choose(8.0, candidates=LADDER, say=said.append).remembered
    assert any("are not used: expected engine, model" in line for line in said)


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        ((), 3, "holds no engines"),
        (("ss",), "fast", "expected engine"),
        (("ss",), [1.0], "expected engine"),
        (("ss", "paced_p99_ms"), "fast", "paced_p99_ms is 'fast', expected type float"),
        (("ss", "paced_p99_ms"), None, "paced_p99_ms is 'None'"),
        (("ss", "paced_p99_ms"), True, "paced_p99_ms is 'True'"),
        (("ss", "paced_p99_ms"), float("nan"), "paced_p99_ms is 'nan'"),
        (("ss", "paced_p99_ms"), -1.0, "paced_p99_ms is '-1.0'"),
        (("ss", "hops"), 300.5, "hops is '300.5', expected type int"),
        (("ss", "complete"), 1, "complete is '1', expected type bool"),
        (("ss", "model"), {"a": 1}, "model is"),
    ],
)
def test_a_cache_of_valid_json_with_wrong_types_inside_is_ignored_and_said(measured, cache, place, value, why):
    choose(8.0, candidates=LADDER)
    file = timings()
    content = json.loads(file.read_text())
    (entry,) = content
    at = content
    *way, last = (entry, *place)
    for step in way:
        at = at[step]
    at[last] = value
    file.write_text(json.dumps(content))
    said = []
    choice = choose(8.0, candidates=LADDER, say=said.append)
    assert choice.engine == "ss" and not choice.remembered
    told = [line for line in said if "are not used" in line]
    assert len(told) == 1 and why in told[0] and "\n" not in told[0], said
    assert choose(8.0, candidates=LADDER).remembered


def test_a_cache_that_cannot_be_written_is_said(measured, cache):
    cache.parent.mkdir()
    cache.write_text("a file where the folder should be")
    said = []
    assert choose(8.0, candidates=LADDER, say=said.append).engine == "ss"
    assert any("cannot be kept" in line and str(cache) in line for line in said)


def test_the_cache_lies_where_the_platform_wants_it(monkeypatch, tmp_path):
    monkeypatch.setattr(platformdirs, "PlatformDirs", Unix)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert timings().parent == tmp_path / "cache/edgefilter"
    for ignored in ("", "relative/folder"):
        monkeypatch.setenv("XDG_CACHE_HOME", ignored)
        assert timings().parent == tmp_path / ".cache/edgefilter"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(platformdirs, "PlatformDirs", MacOS)
    assert timings().parent == tmp_path / "Library/Caches/edgefilter"
    monkeypatch.setattr(platformdirs, "PlatformDirs", Windows)
    monkeypatch.setattr("platformdirs.windows.get_win_folder", lambda name: str(tmp_path / name))
    assert timings().parent == tmp_path / "CSIDL_LOCAL_APPDATA/edgefilter"


def test_measuring_runs_the_whole_path_at_the_real_pace():
    began = time.perf_counter()
    figures = measure(SpectralSubtraction(), Profile.load(DEMO / "profile.npz"), paced=40)
    assert time.perf_counter() - began >= 39 * 0.016
    assert (figures.engine, figures.hop_ms, figures.hops, figures.complete) == ("ss", 16.0, 40, True)
    assert 0 < figures.paced_p50_ms <= figures.paced_p95_ms <= figures.paced_p99_ms <= figures.paced_max_ms


def test_the_figures_are_percentiles_of_what_the_hops_took(monkeypatch):
    asked = []

    def pretend(stream, hops, count, period_s=None):
        asked.append((count, period_s))
        return [float(took) for took in range(count)]

    monkeypatch.setattr(budget, "pace", pretend)
    figures = measure(Bypass(), paced=101)
    assert (figures.paced_p50_ms, figures.paced_p95_ms, figures.paced_p99_ms, figures.paced_max_ms) == (50, 95, 99, 100)
    assert (figures.hops, figures.complete, asked) == (101, True, [(32, 0.0), (101, None)])  # the first are not counted


@pytest.mark.parametrize(("allowed", "cores"), [({3}, 1), ({0, 2, 5}, 2)])
def test_the_choice_says_on_how_many_cores_it_was_measured(measured, monkeypatch, allowed, cores):
    monkeypatch.setattr(budget, "allowed_cores", lambda: allowed)
    choice = choose(8.0, candidates=LADDER)
    assert choice.cores == cores and f"on {cores} cores" in choice.reason


@pytest.mark.parametrize("hop", [160, 256])
def test_the_conversation_comes_from_its_first_sample_on_whole_hops_of_it_over_and_over(hop):
    mic, ref = demo("mic", "reference")
    count, hops = mic.size // hop, scene(hop)
    for _ in range(2):
        for channel, heard in zip((mic, ref), zip(*islice(hops, count), strict=True), strict=True):
            np.testing.assert_array_equal(np.concatenate(heard), channel[: count * hop])


def test_pace_begins_a_hop_each_period_and_counts_only_the_work():
    begun = []

    class Stub(Stream):
        def process(self, mic, ref):
            begun.append(time.perf_counter())
            time.sleep(0.002)
            return super().process(mic, ref)

    hop = np.zeros(256, np.float32)
    before = time.perf_counter()
    took = pace(Stub(Bypass()), iter([(hop, hop)] * 10), 10)
    assert np.all(np.array(begun) - before >= np.arange(10) * 0.016 - 1e-4)  # never early; the resolution of sleep
    assert len(took) == 10 and min(took) >= 2.0


def test_measuring_an_engine_far_too_slow_ends_in_time_and_it_does_not_fit():
    class Slow(Bypass):
        def step(self, frame, state):
            time.sleep(0.1)
            return super().step(frame, state)

    began = time.perf_counter()
    figures = measure(Slow())
    assert time.perf_counter() - began < 3.0  # 300 hops are 4.8 s
    assert not figures.complete and figures.hops < 10 and figures.paced_p50_ms >= 100
    assert not fits(figures, 1000.0)


def test_the_measurement_is_held_to_the_cores_and_lets_go_afterwards():
    before = os.sched_getaffinity(0)
    with held_to(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before
    with pytest.raises(RuntimeError), held_to(1):
        raise RuntimeError
    assert os.sched_getaffinity(0) == before


def run(folder, *more):
    words = ("--output", folder / "out.wav", "--json", folder / "j", "--seconds", "1")
    result = here("run", "--input", DEMO / "human.flac", *words, *more)
    assert result.returncode == 0, result.stderr
    return result.stderr, json.loads((folder / "j").read_text())


@pytest.mark.slow
def test_a_recording_gets_the_strongest_engine_unmeasured_unless_a_budget_is_given(tmp_path):
    said, stats = run(tmp_path)
    assert stats["choice"] is None and "strongest engine, not measured" in said
    said, stats = run(tmp_path, "--budget-ms", "500")
    choice = stats["choice"]
    # on a machine with more to do fewer can be run in time
    assert not choice["remembered"] and choice["fits"] == (choice["figures"][-1]["hops"] == 300)
    assert stats["engine"] == choice["engine"] and choice["reason"] in said and "measuring engine" in said
    said, stats = run(tmp_path, "--budget-ms", "500")
    assert stats["choice"]["remembered"] and "measuring" not in said
    said, stats = run(tmp_path, "--remeasure")
    assert stats["choice"] is None and not list(timings().parent.iterdir())
