"""Learning in another process: the same updates, late, and a filter that does without them where it must."""

import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from edgefilter import BackgroundLearner, EgoFilter, PathLearner, Profile, load_effect
from edgefilter.echo.model import EchoModel
from edgefilter.learning import background
from tests.learning.scenes import Scene, room

HOP = 256
OWN = """
import numpy as np
from edgefilter.echo.effect import Parameter
class Gain:
    name, stage = "own_gain_of_the_learning_test", "source"
    parameters = (Parameter("factor", "1", 1.0, 0.1, 10.0),)
    def apply(self, x, values, sample_rate):
        print("not a message")
        return x * np.float32(values["factor"])
    def fit(self, measurement, model):
        return {"factor": 1.0}
"""


def caught_up(learner, hops):
    """Wait until the other process has taken all hops but those that it has not told of yet."""
    deadline = time.monotonic() + 60
    while learner.stats().get("hops", 0) <= hops - 16:
        assert time.monotonic() < deadline, learner.stats()
        assert learner.stats()["process"] == "running"
        time.sleep(0.01)


def feed(ego, learner, scene, every=100):
    """The whole scene, waiting for the learner now and then, as real time would."""
    out = []
    for count, at in enumerate(range(0, scene.mic.size - HOP + 1, HOP), start=1):
        out.append(ego.process(scene.mic[at : at + HOP], scene.reference[at : at + HOP]))
        if count % every == 0:
            caught_up(learner, count)
    return np.concatenate(out)


def kinds(ego):
    return [event.kind for event in ego.events()]


def learns(ego, learner, scene, before=0):
    """Whether something is learned of the scene, which ends with that; before: hops that the learner had been told of."""
    for count, at in enumerate(range(0, scene.mic.size - HOP + 1, HOP), start=1):
        ego.process(scene.mic[at : at + HOP], scene.reference[at : at + HOP])
        if "learned" in kinds(ego):
            return True
        if count % 100 == 0:
            caught_up(learner, before + count)
    return False


def plain(scene):
    ego = EgoFilter(engine="linear")
    return np.concatenate((ego.process(scene.mic, scene.reference), ego.flush()))


@pytest.fixture(scope="module")
def scene():
    return Scene(seconds=8.0)


@pytest.fixture(scope="module")
def short():
    return Scene(seconds=2.0)


@pytest.mark.slow
def test_it_learns_what_the_learner_in_this_process_does(scene, tmp_path):
    file = tmp_path / "robot.npz"
    learner = BackgroundLearner(remember=file)
    ego = EgoFilter(engine="linear", learn=learner)
    out = feed(ego, learner, scene)
    assert "learned" in kinds(ego)
    for number in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C and a stopped service reach the whole group
        os.kill(learner.pid, number)
    stats = ego.stats()["learning"]
    assert stats["cpu_s"] > 0
    assert stats["memory_mb"] > 0
    last = slice(out.size - 16_000, out.size)
    assert np.mean(out[last] ** 2) < 0.8 * np.mean(plain(scene)[last] ** 2)
    ego.close()
    after = learner.stats()
    assert after["process"] == "ended" and after["remembered"] > 0 and after["hops"] == scene.mic.size // HOP
    assert Profile.load(file).learned


@pytest.mark.slow
def test_a_filter_that_is_used_again_learns_again():
    scene = Scene(seconds=5.0)
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    for end in (ego.flush, ego.close):
        assert learns(ego, learner, scene)
        end()
        ego.reset()
    ego.close()


def test_a_learner_that_was_killed_is_no_zombie_beside_the_running_filter(short):
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    os.kill(learner.pid, signal.SIGKILL)
    until, pid = time.monotonic() + 60, learner.pid
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < until, Path(f"/proc/{pid}/status").read_text()
        ego.process(short.mic[: 16 * HOP], short.reference[: 16 * HOP])
    ego.close()
    assert learner.stats()["process"] == "ended"


@pytest.mark.parametrize("path", [[], [""]], ids=["as it is", "with the working directory"])
def test_what_lies_in_the_working_directory_is_not_run(short, tmp_path, monkeypatch, path):
    for name in ("numpy", "scipy", "edgefilter", "pickle"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'was run')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*path, *sys.path])
    learner = BackgroundLearner()
    feed(EgoFilter(engine="linear", learn=learner), learner, short)
    learner.close()
    assert not (tmp_path / "was run").exists()
    assert learner.stats()["hops"] == short.mic.size // HOP


@pytest.mark.parametrize("program", ["/bin/false", "/nowhere/python"], ids=["dies at once", "is not there"])
def test_the_filter_goes_on_where_the_process_cannot_be_started(short, monkeypatch, program):
    monkeypatch.setattr(sys, "executable", program)
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    time.sleep(0.1)
    out = np.concatenate((ego.process(short.mic, short.reference), ego.flush()))
    np.testing.assert_allclose(out, plain(short), atol=1e-5)
    assert ego.stats()["learning"]["process"] == "ended"
    ego.close()


def test_the_filter_goes_on_where_the_learner_has_died(short):
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    os.kill(learner.pid, signal.SIGKILL)
    time.sleep(0.1)
    out = np.concatenate((ego.process(short.mic, short.reference), ego.flush()))
    np.testing.assert_allclose(out, plain(short), atol=1e-5)
    assert ego.stats()["learning"]["process"] == "ended"
    ego.close()


def test_a_message_of_which_half_has_come_is_taken_when_it_is_whole(tmp_path, monkeypatch):
    data = pickle.dumps(background.News(0, {"hops": 7}, None))
    (tmp_path / "message").write_bytes(background.LENGTH.pack(len(data)) + data)
    (tmp_path / "program").write_text(
        f"#!/bin/sh\ncd {tmp_path}\nhead -c 20 message\ntouch half\nwhile [ ! -e go ]; do sleep 0.01; done\n"
        "tail -c +21 message\ncat >heard\n"
    )
    (tmp_path / "program").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "program"))
    learner, deadline = BackgroundLearner(), time.monotonic() + 60
    ego = EgoFilter(engine="linear", learn=learner)
    while not (tmp_path / "half").exists():
        assert time.monotonic() < deadline
    assert "hops" not in learner.stats() and learner.stats()["heard_s"] == 0.0
    (tmp_path / "go").touch()
    while learner.stats().get("hops") != 7:
        assert time.monotonic() < deadline, learner.stats()
    ego.close()


def test_effects_of_the_users_own_are_known_there_and_may_print(short, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    name = load_effect(tmp_path / "own.py")
    silence, flat = np.full(601, 1e-9, np.float32), np.ones(601, np.float32)
    echo = EchoModel(np.pad(room(2), (64, 0)), ((name, {"factor": 0.5}),))
    profile = Profile(echo, 1200.0, flat, silence, np.array([[900.0, 1100.0]]), np.array([40.0]), np.full(4, -50.0))
    learner = BackgroundLearner(profile)
    ego = EgoFilter(profile, engine="linear", learn=learner)
    feed(ego, learner, short)
    ego.close()
    assert learner.stats()["hops"] == short.mic.size // HOP


@pytest.mark.slow
def test_a_process_that_falls_behind_begins_anew_and_learns(scene):
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    os.kill(learner.pid, signal.SIGSTOP)
    silence = np.zeros(20 * 16_000, np.float32)
    began = time.monotonic()
    ego.process(silence, silence)
    assert time.monotonic() - began < 10  # nobody waits for a process that stands still
    os.kill(learner.pid, signal.SIGCONT)
    caught_up(learner, 300)  # 20 s less the 15 s after which it begins anew
    assert learner.stats()["fell_behind"] == 1
    told = learner.stats()["hops"]
    assert told < 400
    assert learns(ego, learner, scene, before=told)
    ego.close()


def test_a_process_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(background, "GOODBYE_S", 0.5)
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    pid = learner.pid
    os.kill(pid, signal.SIGSTOP)
    closing = threading.Thread(target=ego.close, daemon=True)
    closing.start()
    closing.join(10)
    try:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)  # so that nothing is left of a test that fails
    finally:
        closing.join(10)


@pytest.mark.slow
def test_the_process_ends_with_the_last_one_who_holds_its_learner():
    learner = BackgroundLearner()
    ego = EgoFilter(engine="linear", learn=learner)
    pid = learner.pid
    del ego, learner
    gc.collect()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.slow
def test_the_process_imports_nothing_that_it_does_not_need():
    """Each of these takes 5 to 50 MB and up to a second of a small machine, and none is used to learn."""
    code = "import sys; import edgefilter.learning.worker; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "edgefilter.learning.path_learner" in loaded
    needless = {"soundfile", "soxr", "sounddevice", "onnxruntime", "matplotlib", "jinja2"}
    needless |= {f"scipy.{name}" for name in ("signal", "stats", "optimize", "interpolate", "sparse")}
    needless |= {
        f"edgefilter.{name}" for name in ("audio", "alignment.aligner", "engines", "session", "report", "diagnosis")
    }
    assert not needless & loaded


def test_a_learner_that_was_never_started_closes_in_silence():
    for learner in (BackgroundLearner(), PathLearner()):
        learner.close()
        ego = EgoFilter(engine="bypass", learn=learner)
        assert ego.stats()["learning"] is None
        ego.close()
