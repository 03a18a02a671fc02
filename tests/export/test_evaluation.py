"""`python -m bench`: from folders to tables, the same figures wherever they are computed, and figures that are right."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
import torch
from distributed import LocalCluster

from bench import __main__ as program
from bench.evaluate import denoisers, slices, systems, table, voicefixer, worst
from bench.evaluate.clips import Heard, Laying, NotHere, find_clips
from bench.evaluate.facts import pitch_hz, talking_s
from bench.measure.intervals import cluster_weights, ratio_interval
from bench.measure.real_streams import Cells
from bench.measure.recogniser import find_model
from bench.measure.score_cache import ScoreCache
from edgefilter import enhance
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import create
from edgefilter.errors import UsageError
from tests.bench.conftest import RATE, babble
from tests.bench.evaluated import results

DATA = Path(__file__).parents[1] / "data"
ROWS = "unfiltered,linear-uncalibrated,clean,fan-kept,ideal-mask,dtln-aec"


def run(output: Path, *arguments: object) -> dict:
    assert program.main([*map(str, arguments), "--output", str(output), "--worst", "0"]) == 0
    return json.loads((output / "evaluation.json").read_text())


def figures(found: dict) -> str:
    """Everything but the time that it took, which no two runs share."""
    names = ("groups", "absent", "slices", "conclusions", "clips")
    text = json.dumps({key: found[key] for key in names})
    plain = json.loads(text, parse_float=lambda number: round(float(number), 3))  # workers have other threads
    for group in plain["groups"]:
        for row in group["rows"].values():
            del row["seconds_for_5s"]
    for clip in plain["clips"]:
        for row in clip.values():
            row.pop("seconds", None) if isinstance(row, dict) else None
    return json.dumps(plain)


def test_a_cluster_and_processes_give_the_same_figures_and_a_run_that_was_cut_off_goes_on(
    live: Path, tmp_path: Path
) -> None:
    folder, cache = live.parent, tmp_path / "cache"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        spread = ("--scheduler", cluster.scheduler_address)
        first = run(tmp_path / "a", folder, "--systems", ROWS, "--cache", tmp_path / "elsewhere", *spread)
    again = run(tmp_path / "b", folder, "--systems", ROWS, "--cache", cache, "--jobs", 1)
    assert figures(first) == figures(again)

    lines = (cache / "evaluation.jsonl").read_text().splitlines()
    assert len(lines) == 2 * 6  # five rows that can be had, and what each clip is like
    (cache / "evaluation.jsonl").write_text("\n".join(lines[:-2]) + "\n" + lines[-2][:40])
    resumed = run(tmp_path / "c", folder, "--systems", ROWS, "--cache", cache, "--jobs", 1)
    assert figures(resumed) == figures(first)
    kept = ScoreCache(cache / "evaluation.jsonl")
    assert all(kept.get(json.loads(line)["key"]) for line in lines)

    lab, office = first["groups"]
    assert (lab["room"], office["room"], lab["clips"]) == ("lab", "office", 1)
    row = lab["rows"]["linear-uncalibrated"]
    assert row["si_sdr"]["mean"] > lab["rows"]["unfiltered"]["si_sdr"]["mean"]
    assert lab["rows"]["ideal-mask"]["si_sdr"]["mean"] > row["si_sdr"]["mean"] + 3
    assert lab["rows"]["clean"]["si_sdr"] is None and row["erle_db"]["mean"] > 3 and 0 < row["seconds_for_5s"]
    assert first["absent"]["DTLN-aec"].startswith("no package carries its weights")
    page = (tmp_path / "a" / "evaluation.md").read_text()
    assert page.startswith("# Evaluation\n") and "| linear, uncalibrated | neither |" in page
    assert "<title>edgefilter evaluation</title>" in (tmp_path / "a" / "evaluation.html").read_text()


def test_what_is_no_recording_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert program.main([str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "no */meta.json and no *_lpb and *_mic files" in capsys.readouterr().err
    with pytest.raises(UsageError, match="unknown system 'crm': choose some of unfiltered, "):
        systems.chosen(["crm"])
    with pytest.raises(UsageError, match="nobody is no folder, not pocketsphinx, and no model"):
        find_model("nobody")


def test_humans_are_laid_on_real_recordings_and_others_stay_as_they_are(clips: Path, tmp_path: Path) -> None:
    for name, seconds in (("device1_00", 12.0), ("a_farend", 4.0)):
        for part, seed in (("lpb", 1), ("mic", 2)):
            sf.write(tmp_path / f"{name}_{part}.wav", 0.5 * babble(seconds, seed), RATE)
    laying = Laying(clips, cells=Cells(sers=(0.0, -20.0), befores=(2.0,)), cases=2)
    found = find_clips([tmp_path], laying)
    assert [(clip.room, clip.text) for clip in found[:1]] == [("as recorded, farend", None)]
    assert len(found) == 5 and {clip.text for clip in found[1:]} == {"some words here"}
    heard = Heard(found[1])
    assert si_sdr(heard.mic[heard.source.span], heard.human[heard.source.span]) == pytest.approx(0.0, abs=1.5)
    assert found[1].voice().size == round(3.2 * RATE)  # another recording of the same human
    known = systems.catalogue()
    for name, why in (("linear", "no calibration"), ("aec3-true-lag", "true lag"), ("fan-kept", "no fan_only")):
        with pytest.raises(NotHere, match=why):
            known[name].run(heard)


def test_a_peer_that_is_better_is_shown_as_better() -> None:
    for best in ("crnn", "aec3"):
        made = results(best)
        group = slices.whole(made)
        errors = {"crnn": 4, "aec3": 8} | {best: {"crnn": 1, "aec3": 5}[best]}
        expected = min(errors, key=lambda name: errors[name])
        assert group.best("capped") == expected  # neither the bound nor the row that is told the lag
    peer = results()
    for row in peer.rows:
        row["crnn"], row["aec3"] = row["aec3"], row["crnn"]
    found = table.content(peer)
    assert slices.whole(peer).best("capped") == "aec3"
    for group in found:
        assert group["rows"]["crnn"]["against"]["capped"]["other"] == "aec3"
        assert group["rows"]["crnn"]["against"]["capped"]["low"] > 0  # ours is worse, and surely so


def test_a_glance_has_a_figure_of_each_row_and_group_first() -> None:
    made = results()
    content = {"groups": table.content(made), "conclusions": [], "slices": [], "absent": {}}
    lines = table.markdown(made, content).splitlines()
    assert lines[0] == "## At a glance" and lines[2].startswith("Capped WER, %, whisper;")
    heads, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines[4 : 6 + len(made.systems)]
    ]
    assert heads == ["system", "knows", *(f"{group.name} ({len(group.members)})" for group in made.groups)]
    for system, cells in zip(made.systems, rows, strict=True):
        means = [group["rows"][system.name]["words"]["whisper"]["capped"]["mean"] for group in content["groups"]]
        assert cells[:2] == [system.title, system.knows] and [cell.split()[0] for cell in cells[2:]] == [
            f"{m:.0f}" for m in means
        ]


def test_figures_of_a_row() -> None:
    made = results()
    lab, office = made.groups
    row = lab.figures(made.systems[0])
    words = [made.rows[index]["unfiltered"]["words"]["whisper"] for index in lab.members]
    rates = np.array([100 * one["errors"] / one["words"] for one in words])
    found = row["words"]["whisper"]
    assert found["wer"]["mean"] == pytest.approx(rates.mean()) and found["wer"]["std"] == pytest.approx(
        rates.std(ddof=1)
    )
    assert found["wer"]["median"] == pytest.approx(np.median(rates)) and found["capped"]["mean"] == 100.0
    assert found["pooled"]["mean"] == pytest.approx(10 * np.mean([one["errors"] for one in words]))
    assert found["insertions"]["mean"] > 0 and found["deletions"]["mean"] == 30.0
    assert found["wer"]["low"] < found["wer"]["mean"] < found["wer"]["high"]
    assert row["seconds_for_5s"] == pytest.approx(0.05) and row["clips"] == 12
    assert office.figures(made.systems[-1])["si_sdr"] is None
    alone = lab.part(lab.members[:1]).mean("crnn", "wer")
    assert (alone["low"], alone["high"], alone["count"]) == (None, None, 1)  # of one clip nobody can say


def test_clusters_are_drawn_and_not_utterances() -> None:
    values = np.repeat([0.0, 1.0, 0.0, 1.0], 25)
    alone = ratio_interval(cluster_weights(range(100)), values)
    speakers = ratio_interval(cluster_weights([index // 25 for index in range(100)]), values)
    assert np.subtract(*alone[::-1]) == pytest.approx(2 * 1.96 * 0.05, abs=0.02)  # sqrt(p (1 - p) / n)
    assert speakers == (0.0, 1.0)  # four of them: any share can be drawn
    room = ratio_interval(cluster_weights(range(100), ["one room"] * 100), values)
    assert room == pytest.approx(alone, abs=0.02)
    assert ratio_interval(cluster_weights(range(4)), [1, 2, 3, 4], [2, 4, 6, 8]) == (0.5, 0.5)


def test_slices_hold_every_clip_once_and_the_conclusions_follow_the_figures() -> None:
    made = results()
    found = {one["key"]: one for one in slices.slices(made)}
    assert set(found) == {"level_db", "pitch_hz", "voice"}
    assert [part["clips"] for part in found["level_db"]["rows"]] == [8, 8, 8]
    assert [part["slice"] for part in found["voice"]["rows"]] == ["v0", "v1"]
    quiet, _, loud = (part["systems"]["paper-ss"]["mean"] for part in found["level_db"]["rows"])
    assert quiet > loud
    volume, reverberation, norm = slices.conclusions(made)
    assert slices.correlation(made, "level_db", "paper-ss")[2] < 0 < slices.correlation(made, "level_db", "crnn")[2]
    assert volume["verdict"] == "partly seen here" and "level and paper-ss: -0." in volume["figures"]
    assert reverberation["verdict"] == "seen here as well" and "capped WER: paper-ss +" in reverberation["figures"]
    assert norm["verdict"].startswith("not tested: needs paper-crnn-narrow-batch-norm, or --network batch-norm=")


@pytest.mark.parametrize(("decibels", "verdict"), [(-4.0, "seen here as well"), (4.0, "partly seen here")])
def test_batch_normalisation_is_judged_in_words_and_in_decibels(decibels: float, verdict: str) -> None:
    made = results()
    twins = [replace(made.systems[0], name=name) for name in ("paper-crnn-narrow", systems.NARROW_BATCH_NORM)]
    made = replace(made, systems=(*made.systems, *twins))
    for row in made.rows:  # as many words, and so many dB more
        row[twins[0].name] = row["crnn"]
        row[twins[1].name] = row["crnn"] | {"si_sdr": row["crnn"]["si_sdr"] + decibels}
    found = slices.conclusions(made)[2]
    told = "With it less without: paper-crnn-narrow +0.0 [+0.0, +0.0] points of capped WER; paper-crnn-narrow"
    assert found["verdict"] == verdict
    assert found["figures"].startswith(f"{told} {decibels:+.1f} [{decibels:+.1f}, {decibels:+.1f}] dB of SI-SDR")


def test_the_worst_clips_come_first() -> None:
    made = results()
    made.rows[7]["crnn"]["words"]["whisper"]["errors"] = 9
    assert worst.worst(made, 3)[0] == 7
    heard = worst.heard_by(made, 7)
    assert heard[0]["system"] == "Unfiltered" and heard[2]["wer"] == 90.0


def test_pitch_and_talking() -> None:
    t = np.arange(RATE) / RATE
    voice = sum(np.sin(2 * np.pi * 125 * k * t) / k for k in range(1, 8)).astype(np.float32)
    assert pitch_hz(voice) == pytest.approx(125, rel=0.01)
    assert pitch_hz(np.random.default_rng(0).standard_normal(RATE).astype(np.float32)) is None
    assert talking_s(np.concatenate((voice, np.zeros(RATE, np.float32)))) == pytest.approx(1.0)


def test_networks_of_others_are_run_aligned_and_one_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    x = babble(1.0, 3)
    passed = denoisers.run_dtln(np.ones_like, lambda block: block / 4, x)  # each sample lies in four blocks
    np.testing.assert_allclose(passed, x, atol=1e-6)
    np.testing.assert_allclose(denoisers.run_gtcrn(lambda frame: frame, x), x, atol=1e-6)
    late = np.zeros(denoisers.DELAYS["rnnoise"], np.float32)

    def step(fed: np.ndarray, out: np.ndarray) -> None:
        nonlocal late
        late = np.concatenate((late, fed))
        out[:], late = late[: out.size], late[out.size :]

    assert si_sdr(denoisers._full_band(step, x, 480, 960), x) > 30  # 16 to 48 kHz and back
    monkeypatch.setitem(denoisers.PACKAGES, "gtcrn", ("nobody-has-this", "x.onnx"))
    here, absent = systems.present(systems.chosen(["gtcrn", "clean"]))
    assert [row.name for row in here] == ["clean"]
    assert absent == {"linear, then GTCRN": "needs the package nobody-has-this: pip install --no-deps nobody-has-this"}


def test_the_narrower_network_of_the_paper_filters_what_has_a_calibration_or_says_why_not(
    live: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = systems.chosen(["paper-crnn-narrow"])
    assert row.knows == systems.CALIBRATED and systems.present([row]) == ([row], {})
    clip = find_clips([live.parent])[0]
    heard = Heard(clip)
    out = row.run(heard)
    assert out.shape == heard.mic.shape and out.dtype == np.float32
    wanted = enhance(heard.mic, heard.source.read("ref"), None, "paper-crnn", model=systems.NARROW_CRNN)
    np.testing.assert_array_equal(out, wanted)
    monkeypatch.setitem(vars(heard.source), "profile", None)
    with pytest.raises(NotHere, match="no calibration of this device"):
        row.run(heard)

    other, before = tmp_path / "models" / "paper_crnn_narrow.onnx", row.code()
    row = systems._narrow_crnn("paper-crnn-narrow", other)
    why = (
        "no paper_crnn_narrow.onnx in models/: train one with python -m export.train --network paper --filters 16 2"
        " --lstm 80 --hidden 150"
    )
    assert systems.present([row]) == ([], {row.title: why})
    other.parent.mkdir()
    other.write_bytes((DATA / "paper_crnn.onnx").read_bytes())
    assert systems.present([row]) == ([row], {}) and row.code() != before
    other.write_bytes((DATA / "crnn.onnx").read_bytes())
    assert "type edgefilter-crnn, expected edgefilter-paper-crnn" in systems.present([row])[1][row.title]


def test_the_narrower_network_is_as_wide_as_its_row_and_its_command_say() -> None:
    (row,) = systems.chosen(["paper-crnn-narrow"])
    said = create("paper-crnn", model=systems.NARROW_CRNN).model.session.get_modelmeta().custom_metadata_map
    sizes = json.loads(said["network"])
    assert f"({sizes['parameters'] / 1e6:.1f} of 34 M parameters)" in row.title
    assert (sizes["filters"], sizes["lstm"], sizes["hidden"]) == ([16] * 7 + [2], 80, 150)
    assert systems.NARROW_CRNN.stat().st_size < 4.5e6  # the repository keeps it without special storage


VOICEFIXER = """
import os, torch
class VoiceFixer:
    def __init__(self):
        folder = os.path.join(os.path.expanduser("~"), ".cache/voicefixer")
        self.gain = torch.load(os.path.join(folder, "analysis_module/checkpoints/vf.ckpt"))["gain"]
        self.vocoder = torch.load(os.path.join(folder, "synthesis_module/44100/model.ckpt-1490000_trimed.pt"))["gain"]
    def restore_inmem(self, wav, cuda=False, mode=0):
        assert wav.ndim == 1 and not cuda and mode == 0
        return (torch.from_numpy(wav) * self.gain * self.vocoder)[None].numpy()
"""


def test_voicefixer_is_loaded_from_where_its_package_keeps_its_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(NotHere, match=r"expected .cache/voicefixer/vf.ckpt, in the home folder"):
        voicefixer.restore(np.zeros(10, np.float32))
    assert "SS after post-filtering (VoiceFixer)" in systems.present(systems.chosen(["paper-ss-voicefixer"]))[1]
    for path, gain in zip(voicefixer.WEIGHTS, (0.5, 0.25), strict=True):
        file = tmp_path / voicefixer.FOLDER / path
        file.parent.mkdir(parents=True)
        torch.save({"gain": torch.tensor(gain)}, file)
    (tmp_path / "voicefixer").mkdir()
    (tmp_path / "voicefixer" / "__init__.py").write_text(VOICEFIXER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "voicefixer", raising=False)
    x = babble(0.5, 1)
    out = voicefixer.restore(x)
    assert out.shape == x.shape and si_sdr(out, x) > 30
    assert np.abs(out).max() == pytest.approx(0.125 * np.abs(x).max(), rel=0.02)
    assert "vf.ckpt" in voicefixer.version()
