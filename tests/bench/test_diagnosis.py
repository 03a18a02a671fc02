"""The benchmark of the diagnosis: counts, seals, proof on unseen seconds, and what `add` brings, on the least they take."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

from bench import __main__ as bench
from bench.diagnosis import names, proof, run_time
from bench.diagnosis.names import Outcome
from bench.diagnosis.proof import Row
from bench.simulate import hidden_cases
from bench.simulate.conversations import read_clips
from bench.simulate.hidden_robot import draw_scene
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError
from tests.bench.conftest import RATE, babble
from tests.diagnosis.robot_scene import FAN, path, profile, record, voice


def outcome(
    truth: str,
    verdict: str,
    *named: str,
    strength: str = "clear",
    excess_db: float = 5.0,
    sealed_hit: bool | None = None,
) -> Outcome:
    effects = tuple(truth.split("+")) if truth else ()
    numbers = (tuple(5.0 for _ in named), tuple(0.2 for _ in named), tuple(0.9 for _ in named))
    return Outcome(
        "c", effects, effects, strength, verdict, named, *numbers, excess_db, 0.2, "some words", 1.0, sealed_hit
    )


@pytest.mark.parametrize(
    ("case", "hit", "label"),
    [
        (outcome("rattle", "missing", "rattle"), True, "rattle"),
        (outcome("rattle", "missing", "clock_drift", "rattle"), False, "clock_drift+rattle"),
        (outcome("rattle", "explained"), False, "none"),
        (outcome("none", "explained"), True, "none"),
        (outcome("none", "missing", "rattle"), False, "rattle"),
        (outcome("none", "unexplained"), False, "unknown"),
        (outcome("unknown", "unexplained", "bandlimit"), True, "unknown"),
        (outcome("unknown", "missing", "bandlimit"), False, "bandlimit"),
        (outcome("bandlimit+rattle", "missing", "rattle", "bandlimit"), True, "bandlimit+rattle"),
        (outcome("bandlimit+rattle", "missing", "rattle"), False, "rattle"),
        (outcome("", "missing", "rattle", sealed_hit=True), True, "rattle"),
        (outcome("", "missing", "rattle", sealed_hit=False), False, "rattle"),
        (outcome("none", "error"), False, "error"),
    ],
)
def test_what_counts_as_a_hit(case: Outcome, hit: bool, label: str) -> None:
    assert case.hit is hit and case.label == label


def test_a_name_of_the_same_family_is_half_right() -> None:
    assert outcome("equaliser", "missing", "bandlimit").family_hit and outcome("rattle", "missing", "rattle").family_hit
    assert not outcome("equaliser", "missing", "rattle", "bandlimit").family_hit
    assert not outcome("equaliser", "unexplained").family_hit


def test_cases_are_counted_by_strength_and_kind() -> None:
    cases = [
        *(outcome("rattle", "missing", "rattle"), outcome("rattle", "missing", "mic_agc", "rattle")),
        outcome("bandlimit", "explained", strength="near"),
        *(outcome("none", "explained"), outcome("none", "missing", "rattle")),
        *(
            outcome("unknown", "explained"),
            outcome("unknown", "explained", excess_db=0.5),
            outcome("unknown", "unexplained"),
        ),
        outcome("bandlimit+rattle", "missing", "rattle", "bandlimit", "mic_agc"),
    ]
    assert {name: (count["hits"], count["n"]) for name, count in names.counts(cases).items()} == {
        "one effect: named first": (1, 3),
        "one effect: family right": (1, 3),
        "named first, clear": (1, 2),
        "among the first two, clear": (2, 2),
        "named first, near": (0, 1),
        "among the first two, near": (0, 1),
        "that effect and no other": (1, 3),
        "nothing: false alarms": (1, 2),
        "several effects: all named": (1, 1),
        "all of their families named": (1, 1),
        "at least one named": (1, 1),
        "all and no other": (0, 1),
        "outside the catalogue: unexplained": (1, 3),
        "explained above 1 dB of excess": (1, 3),
    }
    counts, effects, misses = names.tables({"made": cases, "again": cases[-1:]})[:3]
    rows = {row[0]: row[1:] for row in counts["rows"]}
    assert rows["several effects: all named"] == ["1 of 1, 100 [21, 100] %"] * 2
    assert rows["nothing: false alarms"] == ["1 of 2, 50 [9, 91] %", None]
    assert effects["rows"][1] == ["rattle", "1 of 2", 5.0, 0.2, 0.2, 90.0]
    assert (
        len(misses["rows"]) == 5 and ["c", "none", "clear", "missing: rattle", 5.0, 0.2, "some words"] in misses["rows"]
    )


@pytest.mark.parametrize(("label", "hit"), [("bandlimit+rattle", True), ("rattle", False)])
def test_seal_opens_for_the_exact_answer_only(label: str, hit: bool) -> None:
    seal = {"salt": "ab", "sha256": hashlib.sha256(f"ab:c:{label}".encode()).hexdigest()}
    assert names.check_seal(outcome("", "missing", "rattle", "bandlimit"), seal).sealed_hit is hit


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sealed control, 8 s long."""
    x = 1.6 * babble(8.0, 0).astype(float) * signal.windows.tukey(8 * RATE, 0.2)
    scene = draw_scene(np.random.default_rng(0), x, 25.0)
    case = tmp_path_factory.mktemp("cases") / "c00"
    case.mkdir()
    for name, samples in (scene.signals | {"mic": scene.record(scene.usual)}).items():
        sf.write(case / f"{name}.flac", samples, RATE, subtype="PCM_16")
    seals = {"c00": {"salt": "s", "sha256": hashlib.sha256(b"s:c00:none").hexdigest()}}
    (case.parent / "seals.json").write_text(json.dumps(seals), encoding="utf-8")
    return case.parent


@pytest.mark.slow
def test_names_and_proof_of_a_sealed_control_stand_in_one_file(folder: Path, tmp_path: Path) -> None:
    for part in ("names", "proof"):
        assert (
            bench.main(["diagnosis", part, "--cases", str(folder), "--jobs", "1", "--output", str(tmp_path / "out")])
            == 0
        )
    parts = json.loads((tmp_path / "out.json").read_text())["parts"]
    (case,) = parts["names"]["cases"][folder.name]
    assert case["case"] == "c00" and case["truth"] == [] and case["excess_db"] < 1.0
    assert case["sealed_hit"] is (case["verdict"] == "explained")
    (row,) = parts["proof"]["rows"][folder.name]
    assert row["recording"] == "c00" and row["kept"] == [] == row["named"] and not row["declined"]
    assert "| sealed: the exact label |" in (tmp_path / "out.md").read_text()


@pytest.mark.slow
def test_what_a_control_explains_by_chance_is_a_row_and_one_teaches_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["diagnosis", "ordinary", "--cases", str(folder), "--jobs", "1"]
    assert bench.main([*words, "--output", str(tmp_path / "d")]) == 0
    page = (tmp_path / "d.md").read_text()
    assert "| 0.01 | 0 of 1, 0.0 % [" in page or "| 0.01 | 1 of 1, 100.0 % [" in page
    capsys.readouterr()
    assert bench.main([*words, "--learn", str(tmp_path / "o.json")]) == 1
    assert "found 1 recordings to learn from, expected 40" in capsys.readouterr().err
    assert not (tmp_path / "o.json").exists()


def test_folders_without_cases_or_labels_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.main(["diagnosis", "names"]) == 1
    assert "the part 'names' needs --cases" in capsys.readouterr().err
    assert bench.main(["diagnosis", "run-time"]) == 1
    assert "needs --voices and --speech" in capsys.readouterr().err
    with pytest.raises(UsageError, match="holds no"):
        names.find_cases(tmp_path, None)
    (tmp_path / "c00").symlink_to(folder / "c00")
    with pytest.raises(UsageError, match="neither a truth.json nor an entry"):
        names.outcomes(tmp_path, None, 1)


def test_limit_spreads_over_the_folder(tmp_path: Path) -> None:
    for i in range(10):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}" / "mic.flac").touch()
    assert [case.name for case in names.find_cases(tmp_path, 3)] == ["0", "4", "9"]


# ---------------------------------------------------------------- proof


@pytest.mark.slow
def test_what_helps_the_filter_on_the_rest_is_kept() -> None:
    x = voice(9.0)
    elsewhere = EchoModel((0.8 * path(seed=5)).astype(np.float32))  # in the same room
    row = proof.examine("moved", profile(), record(x, elsewhere), x)
    assert row.kept == ("early_path",)
    assert row.kept_db is not None and row.named_db == row.kept_db
    assert row.kept_db[1] > row.kept_db[0] + 2.0  # a filter that starts with the old path has to learn another


def test_a_louder_fan_is_proven_by_the_silences_of_the_rest() -> None:
    x = voice(16.0)
    louder = (record(x) + FAN * np.sqrt(3.0) * np.random.default_rng(8).standard_normal(x.size)).astype(np.float32)
    knowing = profile().echo.with_effect("fan_noise", {"spectrum_db": 6.0})
    before, after = proof.noise_off_db(profile(), knowing, louder, x, 4 * RATE) or (0.0, 0.0)
    assert before == pytest.approx(6.0, abs=0.7) and after < 1.5  # a few frames


def test_a_recording_without_the_robot_is_declined() -> None:
    x = voice(6.0)
    noise = np.random.default_rng(1).standard_normal(x.size).astype(np.float32)
    row = proof.examine("nobody", profile(), FAN * noise, x)
    assert "does not contain the reference" in row.declined and row.kept_db is None


def test_falls_and_rises_are_counted_by_what_a_filter_may_differ_for_no_reason() -> None:
    rows = [
        Row("a", ("x",), ("x",), (10.0, 12.0), (10.0, 12.0)),
        Row("b", ("x", "y"), ("x",), (10.0, 9.0), (10.0, 10.1)),
        Row("c", ("z",), noise_db=(6.0, 1.0)),
        Row("d", declined="no robot: none"),
    ]
    table, each = proof.tables({"set": rows})
    named, kept = table["rows"]
    assert named[:5] == ["set", 4, 1, 2, "all that was named"] and kept[4] == "what was kept"
    assert (named[5]["hits"], named[7:]) == (1, [1, -1.0]) and (kept[5]["hits"], kept[7]) == (1, 0)
    assert "proven: 1 of 1 (set)" in table["text"] and each["rows"][3][1] == "declined: no robot"


def test_a_joined_minute_is_cut_and_a_short_recording_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("device_00", 60), ("short", 12)):
        for end in ("lpb", "mic"):
            sf.write(tmp_path / f"{name}_{end}.wav", np.zeros(seconds * RATE), RATE, subtype="PCM_16")
    monkeypatch.setattr(proof, "examine", lambda name, profile, y, x: (name, y.size, x.size))
    rows = list(proof.of_real(tmp_path, None))
    assert [row[0] for row in rows] == [f"device_00 from {at} s" for at in range(0, 60, 10)] + ["short"]
    assert {row[1] for row in rows[:6]} == {10 * RATE} and rows[6][1] == 12 * RATE


# ---------------------------------------------------------------- what `add` brings


@pytest.fixture(scope="module")
def voices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight clips of one voice: enough for a reference of 20 s."""
    folder = tmp_path_factory.mktemp("voice")
    for i in range(8):
        sf.write(folder / f"{i}.flac", babble(3.5, 20 + i), RATE)
    rows = [f"{i}.flac\ts0\t3.50\tsome words here" for i in range(8)]
    (folder / "transcripts.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


@pytest.mark.slow
def test_the_human_comes_late_and_before_the_microphone(voices: Path) -> None:
    clips = read_clips(voices, (1.0, 15.0))
    scene = hidden_cases.make_conversation(5, "mic_clipping", 0, {"s0": clips}, clips)
    assert scene.effect == "mic_clipping" and scene.mic.shape == scene.ref.shape == scene.clean.shape
    assert np.abs(scene.clean[: scene.human.start]).max() < 1e-9  # rounding of a transform
    assert scene.early + 4 * RATE < scene.human.start
    late = np.abs(scene.mic[scene.human])
    assert np.sum(late > 0.97 * late.max()) > 50  # the sum with the human is limited
    assert np.abs(scene.ref[scene.early - 200 : scene.early + 200]).max() < 0.05 * np.abs(scene.ref).max()  # a pause


@pytest.mark.slow
def test_a_fan_that_is_known_makes_it_better_and_the_page_says_so(voices: Path, tmp_path: Path) -> None:
    arguments = ["--voices", voices, "--speech", voices, "--count", 1, "--effects", "fan_noise", "--seed", 41]
    arguments += ["--engines", "ss", "--output", tmp_path / "found"]
    assert bench.main(["diagnosis", "run-time", *map(str, arguments)]) == 0
    (row,) = json.loads((tmp_path / "found.json").read_text())["parts"]["run_time"]["rows"]
    assert row["erle_more"] > 1  # as much fan more is masked, up to the mask's floor
    assert "| fan_noise |" in (tmp_path / "found.md").read_text()


@pytest.mark.parametrize(("sign", "said"), [(-1, "worse"), (1, "better"), (0, "better")])
def test_better_and_worse_are_said_by_the_intervals(sign: int, said: str) -> None:
    rows = [
        {"effect": "rattle", "engine": "ss", "si_sdr": 5.0, "si_sdr_more": sign * k / 10, "erle_more": 2.0}
        for k in range(1, 9)
    ]
    assert run_time.verdict(rows) == said
    (cells,) = run_time.tables(rows, ["ss"])[0]["rows"]
    assert cells[:3] == ["rattle", 8, 5.0] and cells[-1] == said
