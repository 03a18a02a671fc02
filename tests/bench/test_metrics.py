"""Figures that add up: word errors, levels, barge-in, means with their intervals, and what an unusable output has."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench import metrics
from bench.cache import Cache
from bench.closed_loop import Output
from bench.metrics import difference, excess_db, first_sound, in_time, mean, noticed, pooled, replay
from bench.recogniser import Recogniser, WordErrors, normalise, word_errors
from edgefilter.errors import UsageError
from edgefilter.types import Event
from tests.bench.conftest import RATE, babble, bursts, clip_of


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Mr. O\u2019Neil, aged 42,", "mister o'neil aged forty two"),
        ("the 3rd of May 1839", "the third of may eighteen thirty nine"),
        ("1,200 men -- 'all' of them!", "one thousand two hundred men all of them"),
        ("the 20th in 2005", "the twentieth in two thousand five"),
    ],
)
def test_normalise(text: str, words: str) -> None:
    assert normalise(text) == words


def test_word_errors_counts_and_cap() -> None:
    assert word_errors("one two three four", "one too three") == WordErrors(2, 4, deletions=1)
    assert word_errors("Two words", "") == WordErrors(2, 2, deletions=2)
    robot_heard = word_errors("stop", "and then the robot went on")
    assert robot_heard.rate == 6.0 and robot_heard.capped == 1.0
    with pytest.raises(UsageError, match="no words"):
        word_errors("...", "anything")


def test_recogniser_refuses_a_folder_without_model(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no model.bin"):
        Recogniser(tmp_path, Cache(None))


def test_transcripts_are_kept_by_sound_and_survive_a_cut_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model.bin").write_bytes(b"weights")
    (tmp_path / "config.json").write_text("{}")
    peaks: list[float] = []

    class WhisperModel:
        def __init__(self, folder: str, **options: object) -> None:
            assert folder == str(tmp_path)

        def transcribe(self, samples: np.ndarray, **options: object) -> tuple[list[SimpleNamespace], None]:
            peaks.append(float(np.abs(samples).max()))
            return [SimpleNamespace(text=" said"), SimpleNamespace(text=f" {len(peaks)} ")], None

    monkeypatch.setitem(sys.modules, "faster_whisper", SimpleNamespace(WhisperModel=WhisperModel))
    first, other = babble(0.5, 1), babble(0.5, 2)
    one = Recogniser(tmp_path, Cache(tmp_path / "kept"))
    assert [one.transcribe(x) for x in (first, other, 0.5 * first)] == ["said 1", "said 2", "said 1"]
    assert peaks == pytest.approx([0.5, 0.5])  # every input is scaled to one peak
    assert one.transcribe(np.zeros(100, np.float32)) == ""
    (path,) = (tmp_path / "kept").iterdir()
    path.write_text(path.read_text() + '{"key": "half')
    assert Recogniser(tmp_path, Cache(tmp_path / "kept")).transcribe(other) == "said 2" and len(peaks) == 2


def test_a_line_that_is_appended_after_a_cut_one_is_known(tmp_path: Path) -> None:
    (tmp_path / "scores.jsonl").write_text('{"key": "ha')
    assert Cache(tmp_path).get(lambda: {"a": np.float32(0.5), "b": float("nan")}, "one", np.zeros(3)) == {
        "a": 0.5,
        "b": None,
    }
    again = Cache(tmp_path)
    assert again.get(lambda: pytest.fail("made again"), "one", np.zeros(3)) == {"a": 0.5, "b": None}
    assert again.get(lambda: "other", "one", np.zeros(4)) == "other"


def test_clusters_are_drawn_and_not_recordings() -> None:
    values = np.repeat([0.0, 1.0, 0.0, 1.0], 25)
    rows = [{"clip": str(i), "x": x, "speaker": i, "place": i} for i, x in enumerate(values)]
    alone = mean(rows, "x")
    assert alone["high"] - alone["low"] == pytest.approx(2 * 1.96 * 0.05, abs=0.03)  # sqrt(p (1 - p) / n)
    four = mean([row | {"speaker": row["speaker"] // 25, "place": ""} for row in rows], "x")
    assert (four["low"], four["high"]) == (0.0, 1.0)  # four of them: any share can be drawn
    one = mean(rows[:1], "x")
    assert (one["low"], one["high"], one["count"]) == (None, None, 1)  # of one nobody can say
    assert mean(rows, "unknown") is None


def test_pooled_rates_and_paired_differences() -> None:
    rows = [{"clip": str(i), "errors": i, "words": 2 * i, "capped": 10.0 * i} for i in range(1, 5)]
    found = pooled(rows, "errors", "words")
    assert (found["mean"], found["low"], found["high"], found["count"]) == (50.0, 50.0, 50.0, 20)
    worse = [row | {"capped": row["capped"] + 3.0} for row in rows[1:]]
    less = difference(rows, worse, "capped")
    assert (less["mean"], less["low"], less["high"], less["count"]) == (-3.0, -3.0, -3.0, 3)


def test_a_second_recogniser_counts_beside_the_first() -> None:
    def saying(text: str) -> SimpleNamespace:
        return SimpleNamespace(transcribe=lambda out: text, identity=text)

    alone = metrics.CachedMetrics(Cache(None), saying("one too"))
    both = metrics.CachedMetrics(Cache(None), saying("one too"), saying("one two of the robot's"))
    row = both.words("one two", np.zeros(1, np.float32))
    assert alone.words("one two", np.zeros(1, np.float32)).items() <= row.items() and alone.asked != both.asked
    assert (row["errors"], row["insertions"], row["second_errors"], row["second_insertions"]) == (1, 0, 3, 3)
    assert metrics.CachedMetrics(Cache(None)).words("one two", np.zeros(1, np.float32)) == {}


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda x: x[:-1], "47999 samples for 48000"),
        (lambda x: np.full_like(x, np.nan), "samples that are not finite"),
        (np.zeros_like, "silence where the human speaks"),
    ],
)
def test_an_unusable_output_has_a_problem_and_no_score(spoil, said: str) -> None:
    clip = clip_of(3.0)
    cached = metrics.CachedMetrics(Cache(None))
    row = metrics.score(clip, Output(spoil(clip.mic)), cached)
    assert row["problem"] == said and "si_sdr" not in row
    good = metrics.score(
        clip, Output(clip.human + 0.01 * clip.mic, [Event("speech_started", clip.span.start + 800, "")]), cached
    )
    assert good["si_sdr"] > 10 and good["erle_db"] == pytest.approx(40, abs=0.01)
    assert abs(good["delay_s"] - 0.05) <= 0.02 and not good["early"]
    assert "si_sdr" not in metrics.score(clip, Output(clip.human), cached)  # the human alone


def test_louder_than_the_microphone_is_found_in_one_second_of_ten():
    mic = bursts(0, 10)
    out = 0.1 * mic
    out[3 * RATE : 4 * RATE] = 2 * mic[3 * RATE : 4 * RATE]
    assert excess_db(out, mic) == pytest.approx(20 * np.log10(2), abs=0.01)
    assert excess_db(mic, mic) == 0
    assert excess_db(np.full(RATE // 2, 0.02, np.float32), np.full(RATE // 2, 0.01, np.float32)) == pytest.approx(
        6.02, abs=0.01
    )


def test_one_burst_that_is_left_decides_over_the_energy_and_not_over_the_median_frame():
    mic = np.random.default_rng(0).standard_normal(4 * RATE).astype(np.float32)
    out = 10 ** (-30 / 20) * mic
    out[:RATE] = mic[:RATE]
    assert metrics.frames_db(mic, out) == pytest.approx(30.0, abs=0.01)
    assert metrics.lowered_db(mic, out) == pytest.approx(6.0, abs=0.1)
    mic[2 * RATE :] *= 1e-3  # pauses, in which nothing is lowered
    assert metrics.frames_db(mic, mic * np.repeat([0.1, 1.0], 2 * RATE)) == pytest.approx(20.0, abs=0.01)


def test_noise_out_of_digital_silence_counts_as_louder():
    assert excess_db(bursts(0, 2), np.zeros(2 * RATE, np.float32)) > 60


def test_first_sound_skips_silence_and_breath():
    human = np.concatenate((np.zeros(RATE), 0.001 * bursts(0, 1), bursts(1, 1))).astype(np.float32)
    assert first_sound(human) == 2 * RATE


@pytest.mark.parametrize(
    "kinds, expected",
    [
        ([("speech_started", 18000)], {"delay_s": 0.125, "early": False}),
        (
            [("speech_started", 100), ("speech_stopped", 9000), ("speech_started", 20000)],
            {"delay_s": 0.25, "early": False},
        ),
        (
            [
                ("speech_started", 100),
                ("speech_stopped", 17000),
                ("speech_suspected", 17900),
                ("speech_started", 18000),
            ],
            {"delay_s": None, "early": True},
        ),
        ([("realigned", 17000)], {"delay_s": None, "early": False}),
    ],
)
def test_speech_that_was_on_already_is_not_noticed(kinds, expected):
    assert noticed([Event(kind, sample, "") for kind, sample in kinds], 16000) == expected
    assert in_time(expected) == (expected["delay_s"] is not None)


def test_the_curve_follows_the_packages_rule_at_another_threshold():
    hop = RATE // 10
    probability = [0.7, 0.85, 0.99, 0.3, 0.3, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.9]
    events = [(event.kind, event.sample // hop) for event in replay(probability, hop, 0.8)]
    assert events == [
        *(("speech_suspected", 2), ("speech_started", 3), ("speech_stopped", 11), ("speech_suspected", 12))
    ]
    assert replay(probability, hop, 0.995) == []
