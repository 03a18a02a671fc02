"""The live trial's bookkeeping: where a sentence lies in what was recorded, and what the page says of it."""

import subprocess
import time

import numpy as np

from bench.measure import live_trial_report
from bench.measure.live_trial import Device, located
from bench.simulate.robot_day import interrupt


def test_a_sentence_is_found_where_the_recording_was_moved_and_filled():
    rng = np.random.default_rng(5)
    mic = np.convolve(rng.standard_normal(400_000), np.ones(8) / 8, "same").astype(np.float32)
    sentence = mic[200_000:240_000] + 0.3 * rng.standard_normal(40_000).astype(np.float32)
    for moved in (-30_000, 0, 91_234):
        assert located(sentence, np.roll(mic, moved), 200_000) == 200_000 + moved
    assert located(mic[:32_000], mic, 0) == 0


def test_a_device_hears_by_the_clock_whether_it_was_away_or_not():
    samples = (0.1 * np.random.default_rng(1).standard_normal(20 * 16_000)).astype(np.float32)
    command = ["timeout", "1.2", "parec", "-d", "robot_mic", "--rate=16000", "--channels=1", "--format=s16le", "--raw"]
    with Device("robot_mic", samples) as device:
        device.play(began := time.monotonic())
        ends = []
        for away in (False, True):
            if away:
                device.unplug(), device.plug_in()
            heard = subprocess.run([*command, "--latency-msec=20"], env=device.server.environment, capture_output=True)
            last = np.frombuffer(heard.stdout[-16_000:], "<i2")
            ends.append(located(last / np.float32(32767), samples, 0) / 16_000 + 0.5 - (time.monotonic() - began))
    assert abs(ends[0]) < 0.5 and abs(ends[1] - ends[0]) < 0.3, ends


def test_the_day_says_what_its_human_says_and_where(tmp_path, monkeypatch):
    from bench.simulate import robot_day

    room = type("Room", (), {"human": np.array([0.0, 1.0, 0.5])})
    clips = [robot_day.Clip(tmp_path, "a", "one two"), robot_day.Clip(tmp_path, "b", "three")]
    monkeypatch.setattr(robot_day, "read_speech", lambda clip: np.full(16_000, 0.1 if clip.speaker == "a" else 0.2))
    monkeypatch.setattr(robot_day, "INTERRUPTED", 0.7)
    heard = [slice(at, at + 60_000) for at in range(0, 900_000, 90_000)]
    clean, told = interrupt(np.random.default_rng(0), clips, room, heard, 900_000)
    assert {text for text, _ in told} == {"one two", "three"} and 1 < len(told) < len(heard)
    silent = np.ones(clean.size, bool)
    for _, place in told:
        assert abs(np.mean(clean[place] ** 2) - 1) < 0.01
        silent[place] = False
    assert not clean[silent].any()


def test_the_page_has_a_row_for_each_mishap_and_weighs_sentences_by_their_words():
    sentence = {"begin_s": 61.0, "stage": "office", "during": [], "noticed_s": 0.2, "text": "yes", "heard": "no"}
    wrong = {"human alone": 0.0, "microphone": 1.0, "output": 1.0}
    other = {"during": ["cores busy"], "noticed_s": None, "words": 3, "wrong": {**wrong, "output": 0.0}}
    found = {
        "minutes": 2.0,
        "load_average_before": 0.5,
        "mishaps": [{"name": "cores busy", "begin_s": 60.0, "end_s": 70.0}],
        "stages": [{"name": "office", "begin_s": 0.0}],
        "events": [{"time": 1.0, "kind": "started"}, {"time": 2.0, "kind": "speech_started"}],
        "sentences": [{**sentence, "wrong": wrong, "words": 1}, {**sentence, **other}],
        "stats": {
            "samples_in": 5, "samples_out": 5, "engine": "ss", "source": {"lost": 0, "microphone_gone": 1},
            "deadline": {"missed_deadlines": 1, "hops": 9, "steps": 0, "compute": {"p50_ms": 1.0, "p99_ms": 2.0}},
        },
    }  # fmt: skip
    page = live_trial_report.markdown(found, "trial")
    assert "| office | 1 | 1 of 1 | 0 | 100 | 100 |" in page and "| cores busy | 1 | 0 of 1 | 0 | 100 | 0 |" in page
    assert "| all | 2 | 1 of 2 | 0 | 100 | 25 |" in page and "| microphone gone | 1 |" in page
    assert "speech_started" not in page and "| 1:00.0 | cores busy, 10 s |" in page
