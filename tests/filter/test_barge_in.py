"""The beginning and the end of the human's speech, from probabilities and in the bundled conversation."""

import numpy as np
import pytest
import soundfile

from edgefilter import EgoFilter
from edgefilter.commands.demo import DATA
from edgefilter.commands.run import say_event
from edgefilter.filter.barge_in import PAUSE_S, STARTED, STARTED_HOPS, STOPPED, BargeIn
from edgefilter.types import SAMPLE_RATE, Event


def noted(probabilities: list[float | None]) -> list[str | None]:
    talk = BargeIn(0.016)
    return [talk.note(probability) for probability in probabilities]


def test_a_moment_is_not_speech_and_a_pause_is_not_its_end():
    pause = round(PAUSE_S / 0.016)
    assert not any(noted([STARTED] * (STARTED_HOPS - 1) + [0.1] + [STARTED] * (STARTED_HOPS - 1) + [None] * 100))
    found = noted([STARTED] * STARTED_HOPS + [STOPPED - 0.1] * (pause - 1) + [STOPPED] + [STOPPED - 0.1] * pause)
    assert [(at, what) for at, what in enumerate(found) if what] == [(STARTED_HOPS - 1, "speech_started"), (len(found) - 1, "speech_stopped")]


def test_an_engine_that_stops_judging_ends_the_speech():
    found = noted([1.0] * STARTED_HOPS + [None] * 100)
    assert [what for what in found if what] == ["speech_started", "speech_stopped"]


@pytest.mark.parametrize("alone", [True, False])
def test_in_the_demo_the_human_is_noticed_and_the_robot_is_not(alone):
    mic, ref, human = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference", "human"))
    ego = EgoFilter(DATA / "profile.npz", engine="crnn")
    ego.process(mic - alone * human, ref)
    talk = [event for event in ego.events() if event.kind.startswith("speech")]
    if alone:
        assert not talk and not ego.human_speaks
        return
    assert [event.kind for event in talk] == ["speech_started", "speech_stopped"]
    power = np.square(human[: human.size // 320 * 320]).reshape(-1, 320).mean(1)
    first, last = np.flatnonzero(power > 10**-2.5 * power.max())[[0, -1]] * 320
    assert first < talk[0].sample < first + 0.5 * SAMPLE_RATE
    assert last < talk[1].sample < last + 2 * SAMPLE_RATE


def test_a_live_run_says_when_somebody_speaks_and_a_recording_does_not(capsys):
    for live in (True, False):
        say_event(Event("speech_started", 24000, "probability 0.97"), live=live)
    assert capsys.readouterr().err == "1.5 s: speech started probability 0.97\n"
