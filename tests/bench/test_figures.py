"""The figures of README.md, bench/README.md and docs/diagnosis.md are those of bench/results, and no line mixes runs.

A figure is quoted with the digits that its text has; it must be its result rounded to them. Who moves or rewords a
sentence moves its pattern here; who measures anew takes the file off UNSTAMPED.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.evaluate.table import interval

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "bench" / "results"
FILES = sorted(path.stem for path in RESULTS.glob("*.json"))
UNSTAMPED = (
    "alignment",
    "canceller",
    "diagnosis_story",
    "networks",
    "networks_effect",
    "quality_generated",
    "real_recordings",
    "tune_paper_ss",
)
"""Results from before there were stamps. The list must shrink: whoever measures one of them anew takes it off."""

NUMBER = r"(-?\d+(?:\.\d+)?)"
COLUMNS = {
    "lab": ("moderate/paper", "lab"),
    "office": ("moderate/paper", "office"),
    "lab, live": ("moderate/live", "lab"),
    "office, live": ("moderate/live", "office"),
    "real loudspeaker": ("real", "real loudspeaker"),
}
"""Of the README's first table, by set and room of the evaluation."""
ROWS = {
    "nothing": "unfiltered",
    "spectral subtraction of Li et al. 2024": "paper-ss",
    "VoiceFilter, a small one trained here": "voicefilter",
    "SpeexDSP with its suppressor": "speexdsp-suppressed",
    "WebRTC AEC3": "aec3",
    "`linear`, then GTCRN, the best of four denoisers": "gtcrn",
    "edgefilter `linear`": "linear",
    "edgefilter `ss`": "ss",
    "edgefilter `crnn`": "crnn",
    "edgefilter `crnn`, learning": "crnn-uncalibrated-learning",
    "edgefilter `crnn`, not learning": "crnn-uncalibrated",
    "bound: echo gone, fan kept": "fan-kept",
    "bound: the human alone": "clean",
}


@cache
def result(name: str) -> dict:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


@cache
def text(*names: str) -> str:
    """Documents one after the other, every run of white space a blank."""
    return " ".join(" ".join((ROOT / name).read_text(encoding="utf-8").split()) for name in names)


def quality(file: str, kind: str, room: str, engine: str) -> tuple[float, float]:
    """Mean SI-SDR in dB (not a number for the clean human) and capped word errors in %."""
    found = result(f"quality_{file}")["summary"][kind][room][engine]
    return found.get("si_sdr_mean", np.nan), found["wer_capped"]


def hop(contender: str, paced: bool) -> dict:
    rows = result("latency")["rows"]
    (row,) = (
        r for r in rows if r["contender"] == contender and r["paced"] == paced and r["threads"] == 1 and not r["busy"]
    )
    return row


def paced(contender: str) -> tuple[float, float]:
    return tuple(hop(contender, True)["quantiles"][percent] for percent in ("50", "99"))


def hidden(count: str, folder: str = "hidden_4003") -> tuple[int, int]:
    found = result("hidden_effects")["summary"][folder]["counts"][count]
    return found["hits"], found["n"]


def top_1() -> tuple[int, int]:
    found = [hidden(f"top-1, {strength}") for strength in ("clear", "moderate", "near")]
    return sum(hits for hits, _ in found), sum(n for _, n in found)


def alone(key: str, engine: str = "crnn") -> list[float]:
    return [row[key] for row in result("alone")["rows"] if row["engine"] == engine]


def barge_in() -> dict:
    rows = result("barge_in")["rows"]
    delays = [np.inf if row["delay_ms"] is None else row["delay_ms"] / 1000 for row in rows if not row["early"]]
    p50, p90 = np.quantile(delays, (0.5, 0.9), method="higher")
    return {
        "p50": p50,
        "p90": p90,
        "alarms": sum(r["alarms"] for r in rows),
        "minutes": sum(r["seconds"] for r in rows) / 60,
    }


def learned(kind: str, room: str) -> list[float]:
    """SI-SDR in dB and capped word errors in % of `crnn`, without and with learning."""
    found = result("learning_moderate")["summary"][kind][room]
    return [found[row][key] for row in ("crnn", "crnn-learning") for key in ("si_sdr_mean", "wer_capped")]


def learned_really() -> list[float]:
    """The same on the real loudspeaker."""
    found = result("learning_real")["summary"]
    return [x for row in ("crnn", "crnn-learning") for x in (found[row]["si_sdr"], 100 * found[row]["wer_capped"])]


def utterances() -> list[dict]:
    return [row for block in result("alignment")["lags"].values() for row in block["rows"]]


def aligned() -> tuple[int, int]:
    """Utterances within 1 ms, 16 samples, 300 ms after their first sound."""
    return sum(r["error_300ms"] is not None and abs(r["error_300ms"]) < 16 for r in utterances()), len(utterances())


def time_to_align() -> float:
    """ms, median with a profile."""
    return float(np.median([row["time_ms"] for row in result("alignment")["lags"]["profile"]["rows"]]))


def jumps(long: bool) -> tuple[int, int]:
    """Healed within 200 ms of robot speech."""
    found = [row for row in result("alignment")["jumps"] if (abs(row["jump"]) > 500) == long]
    return sum(row["healed"] and row["ms_of_speech"] <= 200 for row in found), len(found)


def silent_minutes() -> int:
    """Minutes in which nothing was locked onto; not one more than were tried."""
    found = result("alignment")
    return found["false_minutes"] * len(found["false"]) if not any(found["false"].values()) else 0


def story(when: str) -> tuple[float, float]:
    """Of the filter that was restarted: mean SI-SDR in dB, words wrong in %."""
    found = [row[f"restarted_{when}"] for row in result("diagnosis_story")["conversations"]]
    wrong = [min(score["errors"] / score["words"], 1) for score in found]
    return float(np.mean([score["si_sdr"] for score in found])), 100 * float(np.mean(wrong))


def real(system: str) -> dict:
    return result("real")["summary"][system]


def real_barge_in() -> list[float]:
    """Minutes of the robot alone, starts in them, and % of humans noticed in time."""
    alone = [row for row in result("real")["rows"] if row["system"] == "crnn" and row["part"] == "alone"]
    return [sum(r["seconds"] for r in alone) / 60, sum(r["false_starts"] for r in alone), 100 * real("crnn")["in_time"]]


def ahead(kind: str, ser: float | None) -> float:
    """DB by which the best linear filter is ahead, mean."""
    rows = [r for r in result("oracle")["rows"] if (r["kind"], r["ser"]) == (kind, ser)]
    return float(np.mean([r["oracle_db"] - r["linear_db"] for r in rows]))


def seconds() -> tuple[float, float]:
    found = result("hidden_effects")["summary"]["hidden_4003"]["seconds"]
    return found["p50"], found["max"]


DOCUMENTS = ("README.md", "bench/README.md", "docs/diagnosis.md")
FIGURES: dict[str, tuple[tuple[str, ...], Callable[[], object]]] = {
    # a pattern with a group a figure: the results that it is from, and what makes the figures in the groups' order
    rf"unfiltered: {NUMBER} dB in the lab, {NUMBER} dB in the office": (
        ("quality_generated",),
        lambda: [quality("generated", "paper", room, "unfiltered")[0] for room in ("lab", "office")],
    ),
    rf"`crnn` {NUMBER} / {NUMBER} in the lab, {NUMBER} / {NUMBER} in the office; "
    rf"live {NUMBER} / {NUMBER} and {NUMBER} / {NUMBER}": (
        ("quality_shared",),
        lambda: [
            x for kind in ("paper", "live") for room in ("lab", "office") for x in quality("shared", kind, room, "crnn")
        ],
    ),
    rf"learning takes `crnn` from {NUMBER} / {NUMBER} to {NUMBER} / {NUMBER} in the lab, "
    rf"from {NUMBER} / {NUMBER} to {NUMBER} / {NUMBER} in the office, live from {NUMBER} / {NUMBER} to {NUMBER} / {NUMBER} "
    rf"and from {NUMBER} / {NUMBER} to {NUMBER} / {NUMBER}; on the real": (
        ("learning_moderate",),
        lambda: [
            x for kind in ("moderate_paper", "moderate_live") for room in ("lab", "office") for x in learned(kind, room)
        ],
    ),
    rf"on the real loudspeaker from {NUMBER} / {NUMBER} to {NUMBER} / {NUMBER}": (
        ("learning_real",),
        lambda: learned_really(),
    ),
    rf"[Aa]ligned {NUMBER} ms \(median\) after its first sound": (("alignment",), lambda: [time_to_align()]),
    rf"p50 / p99: `ss` {NUMBER} / {NUMBER} ms, `crnn` {NUMBER} / {NUMBER} ms": (
        ("latency",),
        lambda: [*paced("ss"), *paced("crnn")],
    ),
    rf"back to back {NUMBER} and {NUMBER} of one core": (
        ("latency",),
        lambda: [hop(name, False)["real_time_factor"] for name in ("ss", "crnn")],
    ),
    rf"start to first hop {NUMBER} s": (
        ("latency",),
        lambda: [np.median([s["seconds"] for s in result("latency")["start"]["crnn"]])],
    ),
    rf"named first in {NUMBER} of {NUMBER}, both of two in {NUMBER} of {NUMBER}, "
    rf"{NUMBER} false alarms in {NUMBER}, {NUMBER} of {NUMBER} that are": (
        ("hidden_effects",),
        lambda: [
            *top_1(),
            *hidden("pairs: both named"),
            *hidden("false alarms on controls"),
            *hidden("outside: unexplained"),
        ],
    ),
    rf"human is {NUMBER} / {NUMBER} with `ss` and {NUMBER} / {NUMBER} with `crnn` "
    rf"\(SpeexDSP {NUMBER} / {NUMBER}, WebRTC AEC3 {NUMBER} / {NUMBER}; three": (
        ("real",),
        lambda: [real(s)[key] for s in ("ss", "crnn", "speexdsp", "aec3") for key in ("echo_mos", "human_mos")],
    ),
    rf"end at {NUMBER} dB with `linear`, {NUMBER} with `ss`, {NUMBER} with `crnn` "
    rf"\(SpeexDSP {NUMBER}, AEC3 {NUMBER}\), none of {NUMBER}": (
        ("real",),
        lambda: [
            *(real(s)["si_sdr"] for s in ("linear", "ss", "crnn", "speexdsp", "aec3")),
            *{real(s)["cases"] for s in ("linear", "ss", "crnn") if not real(s)["below_microphone"]},
        ],
    ),
    rf"In {NUMBER} minutes of that robot alone `speech_started` fired {NUMBER} times; "
    rf"of humans 20 dB below it {NUMBER} %": (("real",), lambda: real_barge_in()),
    rf"by {NUMBER} dB where the human is 20 dB below, by {NUMBER} dB where both": (
        ("oracle",),
        lambda: [ahead("real", -20.0), ahead("real", 0.0)],
    ),
    rf"it is {NUMBER} to {NUMBER} dB ahead of that filter": (
        ("oracle",),
        lambda: [-ahead("simulated lab", None), -ahead("simulated office", None)],
    ),
    rf"with distortion at -\d+ to -\d+ dB `crnn` ends at {NUMBER} dB in the lab \(`ss` {NUMBER}\)": (
        ("quality_generated",),
        lambda: [
            np.mean([quality("generated", kind, "lab", e)[0] for kind in ("paper", "live")]) for e in ("crnn", "ss")
        ],
    ),
    rf"and at {NUMBER} to {NUMBER} dB in the office \(`ss` {NUMBER} to {NUMBER}\)": (
        ("quality_generated",),
        lambda: [
            quality("generated", kind, "office", e)[0]
            for e, kinds in (("crnn", ("live", "paper")), ("ss", ("paper", "live")))
            for kind in kinds
        ],
    ),
    rf"comes out of `crnn` with {NUMBER}-{NUMBER} dB of SI-SDR, the more the louder, in the worst of {NUMBER} conversations {NUMBER} dB": (
        ("alone",),
        lambda: [
            *(np.median(alone(f"human x {gain}")) for gain in (1, 10)),
            len(alone("robot")),
            min(min(alone(f"human x {gain}")) for gain in (1, 3, 10)),
        ],
    ),
    rf"robot is left {NUMBER} dB below the fan \(median; {NUMBER} dB above it in the worst of {NUMBER} conversations": (
        ("alone",),
        lambda: [-np.median(alone("robot")), max(alone("robot")), len(alone("robot"))],
    ),
    rf"noticed {NUMBER} s \(median; p90 {NUMBER} s\) after the human's first sound, "
    rf"{NUMBER} false alarms in {NUMBER} minutes": (
        ("barge_in",),
        lambda: [barge_in()[key] for key in ("p50", "p90", "alarms", "minutes")],
    ),
    rf"lag is found \({NUMBER} ms after its first sound, median\)": (("alignment",), lambda: [time_to_align()]),
    rf"{NUMBER} of {NUMBER} utterances within 1 ms of their lag": (("alignment",), lambda: aligned()),
    rf"{NUMBER} of {NUMBER} dropped buffers of up to 500 samples healed within 200 ms of robot speech, "
    rf"{NUMBER} of {NUMBER} of 1500": (
        ("alignment",),
        lambda: [*jumps(False), *jumps(True)],
    ),
    rf"nothing locked onto in {NUMBER} minutes": (("alignment",), lambda: [silent_minutes()]),
    rf"named first \| {NUMBER} of {NUMBER} / {NUMBER} of {NUMBER} / {NUMBER} of {NUMBER} \|": (
        ("hidden_effects",),
        lambda: [x for strength in ("clear", "moderate", "near") for x in hidden(f"top-1, {strength}")],
    ),
    rf"false alarm \| {NUMBER} of {NUMBER} \|": (("hidden_effects",), lambda: hidden("false alarms on controls")),
    rf"both named \| {NUMBER} of {NUMBER} \|": (("hidden_effects",), lambda: hidden("pairs: both named")),
    rf"catalogue: `unexplained` \| {NUMBER} of {NUMBER} \|": (
        ("hidden_effects",),
        lambda: hidden("outside: unexplained"),
    ),
    rf"median, longest \| {NUMBER}, {NUMBER} \|": (("hidden_effects",), seconds),
    rf"named first in {NUMBER} of {NUMBER} that hide one effect, both effects in {NUMBER} of {NUMBER}": (
        ("hidden_effects",),
        lambda: (
            [sum(hidden(f"top-1, {s}", "dev")[i] for s in ("clear", "moderate", "near")) for i in (0, 1)]
            + [*hidden("pairs: both named", "dev")]
        ),
    ),
    rf"{NUMBER} of {NUMBER} controls raise a false alarm, "
    rf"{NUMBER} of {NUMBER} from outside the catalogue are `unexplained`": (
        ("hidden_effects",),
        lambda: [*hidden("false alarms on controls", "dev"), *hidden("outside: unexplained", "dev")],
    ),
    rf"{NUMBER} of {NUMBER} sealed ones match their seal": (
        ("hidden_effects",),
        lambda: hidden("sealed: exact label", "sealed"),
    ),
    rf"\| mean \| \| {NUMBER} -> {NUMBER} \|": (
        ("diagnosis_story",),
        lambda: [
            np.mean([r[f"excess_{when}_db"] for r in result("diagnosis_story")["conversations"]])
            for when in ("before", "after")
        ],
    ),
    rf"\| mean .{{30,60}} \| {NUMBER} / {NUMBER} -> {NUMBER} / {NUMBER} \|": (
        ("diagnosis_story",),
        lambda: [*story("before"), *story("after")],
    ),
}


def assert_rounded(shown: str, value: float, what: str) -> None:
    """The shown text is the value rounded to its digits; half a unit of the last digit either way."""
    unit = 10.0 ** -len(shown.partition(".")[2])
    assert abs(float(shown) - value) <= 0.5 * unit + 1e-9, f"{what}: the text says {shown}, the result {value:.4g}"


def table() -> Iterator[list[str]]:
    """Lines of the README's first table, each as its cells."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("| SI-SDR dB / words wrong % "))
    for line in lines[start:]:
        if not line.startswith("|"):
            return
        yield [cell.strip() for cell in line.strip("|").split("|")]


def evaluated(column: tuple[str, str], system: str) -> str:
    """SI-SDR in dB and capped word errors in %, with their interval; no SI-SDR of the clean human, nothing where none was."""
    (group,) = (one for one in result("evaluation")["groups"] if (one["set"], one["room"]) == column)
    row = group["rows"][system]
    words = interval((row["words"]["whisper"] or {}).get("capped"), 0)
    return f"{row['si_sdr']['mean']:.1f} / {words}" if words and row["si_sdr"] else words


def test_the_table_of_the_readme_is_of_the_results() -> None:
    heads, _, *rows = table()
    assert heads[2:] == list(COLUMNS) and [row[0] for row in rows] == list(ROWS)
    for name, _, *cells in rows:
        assert cells == [evaluated(column, ROWS[name]) for column in COLUMNS.values()], name


@pytest.mark.parametrize("pattern", FIGURES)
def test_a_named_figure_is_of_its_result(pattern: str) -> None:
    found = re.findall(pattern, text(*DOCUMENTS))
    assert found, f"no document says this any more: {pattern}"
    values = list(FIGURES[pattern][1]())
    for groups in found:
        for shown, value in zip((groups,) if isinstance(groups, str) else groups, values, strict=True):
            assert_rounded(shown, value, pattern)


def test_the_story_told_is_the_one_that_was_measured() -> None:
    """Every row of the table in docs/diagnosis.md stands in the page of the result, letter by letter."""
    page = (RESULTS / "diagnosis_story.md").read_text(encoding="utf-8").splitlines()
    lines = (ROOT / "docs/diagnosis.md").read_text(encoding="utf-8").splitlines()
    told = [line for line in lines if re.match(r"\| (office|lab)_\d+ \||\| mean \|", line)]
    assert len(told) == len(result("diagnosis_story")["conversations"]) + 1
    assert [line for line in told if line not in page] == []


def assert_one_run(names: set[str], what: str) -> None:
    """Results that share a line have one stamp: the same code and, of each model that both used, the same file."""
    stamps = {name: result(name).get("stamp") for name in names}
    assert len({stamp is None for stamp in stamps.values()}) == 1, (
        f"{what} mixes results with and without a stamp: {sorted(names)}"
    )
    if None not in stamps.values():
        assert len({stamp["code"] for stamp in stamps.values()}) == 1, (
            f"{what} mixes runs of different code: {sorted(names)}"
        )
        files: dict[str, set[str]] = {}
        for stamp in stamps.values():
            for model, about in stamp["models"].items():
                files.setdefault(model, set()).add(about["sha256"])
        assert all(len(hashes) == 1 for hashes in files.values()), f"{what} mixes different files of a model: {files}"


def test_no_line_mixes_runs() -> None:
    for pattern, (names, _) in FIGURES.items():
        assert_one_run(set(names), pattern)


def test_results_without_a_stamp_are_those_on_the_list() -> None:
    without = {name for name in FILES if "stamp" not in result(name)}
    assert without - set(UNSTAMPED) == set(), "results are written by bench/results_writer.py, which stamps them"
    assert set(UNSTAMPED) - without == set(), "these have a stamp (or are gone): take them off UNSTAMPED"


def test_a_stamp_is_of_committed_code_and_stands_on_the_page_as_well() -> None:
    for name in set(FILES) - set(UNSTAMPED):
        stamp, page = result(name)["stamp"], (RESULTS / f"{name}.md").read_text(encoding="utf-8")
        assert re.fullmatch("[0-9a-f]{40}", stamp["commit"]) and not stamp["dirty"], (
            f"{name} was made by code that is not committed"
        )
        assert re.fullmatch("[0-9a-f]{64}", stamp["code"]) and stamp["machine"] and stamp["date"].endswith("UTC")
        hashes = [entry["sha256"] for entry in (*stamp["data"], *stamp["models"].values())]
        assert all(shown[:12] in page for shown in (stamp["commit"], *hashes)) and stamp["command"] in page


def test_results_name_no_folder_of_a_machine() -> None:
    assert len(FILES) >= 15
    for path in RESULTS.iterdir():
        if path.suffix in (".json", ".md"):
            found = re.findall(
                r"(?<![\w.])/(?:home|root|tmp|work|Users|mnt|data)/\S*", path.read_text(encoding="utf-8")
            )
            assert not found, f"{path.name}: {found[:3]}"


@pytest.mark.parametrize(
    ("shown", "value", "right"), [("9.9", 9.94, True), ("9.9", 9.96, False), ("35", 35.4, True), ("-5.0", -5.04, True)]
)
def test_rounding_is_to_the_digits_that_are_shown(shown: str, value: float, right: bool) -> None:
    if right:
        assert_rounded(shown, value, "")
    else:
        with pytest.raises(AssertionError, match="the text says 9.9, the result 9.96"):
            assert_rounded(shown, value, "")


@pytest.mark.parametrize("change", [{"code": "2"}, {"models": {"crnn_int8.onnx": {"sha256": "b"}}}, None])
def test_a_line_of_two_runs_is_found(change: dict | None, monkeypatch: pytest.MonkeyPatch) -> None:
    first = {"code": "1", "models": {"crnn_int8.onnx": {"sha256": "a"}}}
    stamps = {"one": {"stamp": first}, "two": {"stamp": {**first, **change}} if change else {}}
    monkeypatch.setitem(globals(), "result", stamps.__getitem__)
    assert_one_run({"one"}, "a line")
    with pytest.raises(AssertionError, match="a line mixes"):
        assert_one_run({"one", "two"}, "a line")
