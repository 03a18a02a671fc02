"""The beginning and the end of the human's speech, from probabilities and in the bundled conversation."""

from functools import partial

import numpy as np
import pytest
import soundfile

from edgefilter import EgoFilter
from edgefilter.commands.demo import DATA
from edgefilter.commands.display import say_event
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import UsageError
from edgefilter.filter.barge_in import BargeIn, BargeInSettings, HumanJudge
from edgefilter.filter.excess import Excess
from edgefilter.types import SAMPLE_RATE, Event, Frame

HOP_S = 0.016
STFT = StftConfig()
UNSURE = 0.3


def noted(probabilities: list[float | None], settings: BargeInSettings | None = None) -> list[str | None]:
    talk = BargeIn(HOP_S, settings)
    return [talk.note(probability) for probability in probabilities]


def test_a_moment_is_not_speech_and_a_pause_is_not_its_end():
    settings = BargeInSettings(threshold=0.9, release=0.5, min_speech_s=3 * HOP_S, min_silence_s=30 * HOP_S)
    assert not any(noted([0.9, 0.9, 0.1, 0.9, 0.9] + [None] * 100, settings))
    found = noted([0.9] * 3 + [0.49] * 29 + [0.5] + [0.49] * 30, settings)
    happened = [(at, what) for at, what in enumerate(found) if what]
    assert happened == [(2, "speech_started"), (len(found) - 1, "speech_stopped")]


def test_an_engine_that_stops_judging_ends_the_speech():
    found = noted([1.0] * 3 + [None] * 100)
    assert [what for what in found if what] == ["speech_started", "speech_stopped"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threshold": 1.0}, "release 0.4 and threshold 1.0, expected probabilities"),
        ({"release": 0.98}, "release 0.98 and threshold 0.97"),
        ({"release": 0.0}, "release 0.0"),
        ({"threshold": float("nan")}, "threshold nan"),
        ({"min_silence_s": -1.0}, "min_silence_s -1.0, expected seconds"),
        ({"judge": "me"}, "judge 'me', expected one of engine, network"),
    ],
)
def test_settings_that_mean_nothing_are_one_line(settings, message):
    with pytest.raises(UsageError, match=message):
        BargeInSettings(**settings)


class Room:
    """Frames of a robot whose rest is 20 dB below its echo, of a room's noise, and of a human, all of random phase."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._hops = 0

    def _random(self, level: float) -> np.ndarray:
        parts = self._rng.standard_normal((2, STFT.bins))
        return level * (parts[0] + 1j * parts[1])

    def frame(self, robot: float = 0.0, human: float = 0.0) -> Frame:
        """One hop; the robot's loudness goes up and down four times a second, the room stays at 0.01."""
        self._hops += 1
        echo = self._random(robot * (1.0 + 0.9 * np.sin(2 * np.pi * 4 * HOP_S * self._hops)))
        error = 0.1 * echo * self._random(0.7) + self._random(0.01) + self._random(human)
        echo, error = echo.astype(np.complex64), error.astype(np.complex64)
        nothing = np.zeros(STFT.bins, np.float32)
        return Frame(echo + error, echo, echo, error, nothing, nothing)


def test_what_the_robot_leaves_is_learned_and_a_human_stands_above_it():
    room, excess = Room(), Excess(STFT)
    alone = [excess.step(frame.echo, frame.error) for frame in (room.frame(robot=1.0) for _ in range(600))]
    # the rest is 20 dB down where 13 are assumed; the mean of the log of a bin of noise is half a deviation below 0
    assert np.mean(alone[:30]) < np.mean(alone[400:]) < 0.0
    assert max(alone[400:]) < 0.75
    frames = [room.frame(robot=1.0, human=1.0) for _ in range(20)]
    assert np.mean([excess.step(frame.echo, frame.error) for frame in frames]) > 1.0


def test_a_human_who_keeps_talking_does_not_become_what_is_expected():
    room, excess = Room(), Excess(STFT)
    for _ in range(600):
        frame = room.frame(robot=1.0)
        excess.step(frame.echo, frame.error)
    syllables = [hop % 16 < 10 for hop in range(190)]  # three seconds
    frames = [room.frame(robot=1.0, human=float(voiced)) for voiced in syllables]
    above = np.array([excess.step(frame.echo, frame.error) for frame in frames])
    assert above[-64:][syllables[-64:]].mean() > 0.75


def test_steady_noise_that_the_network_takes_for_somebody_is_nobody_while_the_robot_is_silent():
    room, judge = Room(), HumanJudge(STFT)
    threshold = BargeInSettings().threshold
    assert max(judge.step(room.frame(), 0.9999) for _ in range(300)) < 0.5
    heard = [judge.step(room.frame(human=0.05), 0.9999) for _ in range(10)]
    assert max(heard) > threshold  # 14 dB above the room, within 0.16 s


def test_while_the_robot_speaks_the_network_decides():
    room, judge = Room(), HumanJudge(STFT)
    threshold = BargeInSettings().threshold
    alone = [judge.step(room.frame(robot=1.0), UNSURE) for _ in range(300)]
    sure = [judge.step(room.frame(robot=1.0), 0.9999) for _ in range(10)]
    assert max(alone) < 0.1 and max(sure) > threshold


def test_one_sure_hop_does_not_interrupt_a_robot_that_nobody_calibrated():
    heard = {}
    for calibrated in (False, True):
        room, judge = Room(), HumanJudge(STFT, calibrated)
        for _ in range(100):
            judge.step(room.frame(robot=1.0), UNSURE)
        heard[calibrated] = [judge.step(room.frame(robot=1.0), 1.0) for _ in range(3)]
    threshold = BargeInSettings().threshold
    assert heard[False][0] < threshold < heard[True][0]
    assert heard[False][2] > threshold


def test_a_robot_that_sounds_like_somebody_for_moments_learns_to_doubt_them():
    room, judge = Room(), HumanJudge(STFT)
    threshold = BargeInSettings().threshold

    def bursts(seconds: float) -> int:
        """Hops at which a robot that the network takes for somebody, 0.1 s of every second, would be stopped."""
        hops = range(round(seconds / 0.016))
        said = [judge.step(room.frame(robot=1.0), 0.9985 if hop % 60 < 6 else UNSURE) for hop in hops]
        return sum(probability > threshold for probability in said)

    assert bursts(4.0) > 10
    bursts(10.0)
    assert bursts(10.0) == 0
    assert max(judge.step(room.frame(robot=1.0), 0.9999) for _ in range(12)) > threshold  # somebody does speak


def test_who_interrupts_again_and_again_is_noticed_each_time_as_soon():
    room, judge = Room(), HumanJudge(STFT)
    delays = []
    for _ in range(12):
        for _ in range(125):
            judge.step(room.frame(robot=1.0), UNSURE)
        said = [judge.step(room.frame(robot=1.0), 0.9985) for _ in range(60)]
        delays.append(next(hop for hop, probability in enumerate(said) if probability > BargeInSettings().threshold))
    assert max(delays) < 6


def test_an_utterance_that_is_not_found_yet_holds_the_probability_down_and_teaches_nothing():
    room, judge, same = Room(), HumanJudge(STFT), HumanJudge(STFT)
    for _ in range(100):
        frame = room.frame(robot=1.0)
        judge.step(frame, UNSURE)
        same.step(frame, UNSURE)
    for _ in range(30):
        frame = room.frame(robot=1.0, human=10.0)
        assert judge.step(frame, 1.0, suspect=True) == 0.0
        same.step(frame, 1.0)
    frame = room.frame(robot=1.0)
    judge.step(frame, 0.5), same.step(frame, 0.5)
    assert np.all(judge._excess._log_gain < same._excess._log_gain)


def test_while_an_utterance_is_looked_for_it_takes_a_surer_sign_and_a_sure_one_will_do():
    threshold, odds = BargeInSettings().threshold, {}
    for begun in (False, True):
        for said in (0.997, 0.9999):
            room, judge = Room(), HumanJudge(STFT, calibrated=True)
            for _ in range(100):
                judge.step(room.frame(), UNSURE)
            odds[begun, said] = max(judge.step(room.frame(human=0.05), said, begun=begun) for _ in range(12))
    assert odds[False, 0.997] > threshold > odds[True, 0.997] and odds[True, 0.9999] > threshold


@pytest.mark.slow
def test_an_utterance_is_looked_for_from_its_first_sample_until_its_lag_is_found(monkeypatch):
    mic, ref = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    usual, told = HumanJudge.step, []

    def step(self, frame, probability, suspect=False, begun=False):
        told.append(begun)
        return usual(self, frame, probability, suspect, begun)

    monkeypatch.setattr(HumanJudge, "step", step)
    ego = EgoFilter(DATA / "profile.npz", engine="crnn")
    ego.process(mic, ref)
    first = int(np.flatnonzero(np.abs(ref) > 1e-3)[0]) // ego.hop
    found = next(event.sample for event in ego.events() if event.kind == "realigned") // ego.hop
    assert not any(told[: first - 1]) and all(told[first + 1 : found - 1]) and found - first > 3
    assert not any(told[found : found + 60])


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_probabilities_stay_in_0_to_1_whatever_comes(probability):
    judge, silence = HumanJudge(STFT), np.zeros(STFT.bins, np.complex64)
    loud = np.full(STFT.bins, 1e6, np.complex64)
    nothing = np.zeros(STFT.bins, np.float32)
    for echo, error in [(silence, silence), (loud, silence), (silence, loud), (loud, loud)] * 40:
        answer = judge.step(Frame(error, echo, echo, error, nothing, nothing), probability)
        assert 0.0 <= answer <= 1.0


def test_an_engine_without_a_network_gives_no_probability_and_no_events():
    mic, ref = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    ego = EgoFilter(DATA / "profile.npz", engine="ss")
    ego.process(mic, ref)
    assert ego.speech_probability is None and not ego.human_speaks
    assert not [event for event in ego.events() if event.kind.startswith("speech")]


def test_the_network_can_judge_beside_an_engine_that_does_not_and_changes_nothing_of_its_sound():
    mic, ref = (
        soundfile.read(DATA / f"{name}.flac", dtype="float32")[0][:SAMPLE_RATE] for name in ("mic", "reference")
    )
    network = BargeInSettings(judge="network")
    found = {}
    for name, engine, settings in (("ss", "ss", None), ("judged", "ss", network), ("crnn", "crnn", network)):
        ego = EgoFilter(DATA / "profile.npz", engine=engine, barge_in=settings)
        out = [ego.process(mic[at : at + 256], ref[at : at + 256]) for at in range(0, mic.size, 256)]
        found[name] = np.concatenate(out), ego.speech_probability, ego
    assert np.array_equal(found["judged"][0], found["ss"][0])
    assert found["judged"][1] == found["crnn"][1] and found["ss"][1] is None
    stats = found["judged"][2].stats()
    assert stats["engine"] == "ss" and stats["model"] == found["crnn"][2].stats()["model"]


def test_engines_that_take_other_frames_cannot_judge_for_one_another():
    with pytest.raises(
        UsageError, match="engine crnn cannot judge speech for bypass: its front is full, expected none"
    ):
        EgoFilter(engine="bypass", barge_in=BargeInSettings(judge="network"))


@pytest.mark.slow
def test_the_settings_reach_the_stream_and_who_gives_a_callback_is_called_when_the_human_begins():
    mic, ref = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    found = []
    for settings in (BargeInSettings(min_speech_s=0.2), BargeInSettings()):
        called: list[Event] = []
        ego = EgoFilter(DATA / "profile.npz", engine="crnn", barge_in=settings, on_barge_in=called.append)
        ego.process(mic, ref)
        assert called and called == [event for event in ego.events() if event.kind == "speech_started"]
        found.append(called[0].sample)
    assert found[0] >= found[1] + 0.15 * SAMPLE_RATE


@pytest.mark.parametrize("block", [255, 256_000])
@pytest.mark.slow
def test_a_callback_that_raises_costs_no_sample(block):
    """256000 samples went in and 248320 came out."""
    mic, ref = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference"))
    settings = BargeInSettings(min_silence_s=0.1)  # speech begins several times
    usual = EgoFilter(DATA / "profile.npz", engine="crnn", barge_in=settings)
    wanted = np.concatenate((usual.process(mic, ref), usual.flush()))
    started = [event.sample for event in usual.events() if event.kind == "speech_started"]

    def fail(event: Event) -> None:
        raise RuntimeError(event.sample)

    ego, out, raised = EgoFilter(DATA / "profile.npz", engine="crnn", barge_in=settings, on_barge_in=fail), [], []
    blocks = [(mic[at : at + block], ref[at : at + block]) for at in range(0, mic.size, block)]
    for call in (*(partial(ego.process, *each) for each in blocks), ego.flush, ego.flush):
        try:
            out.append(call())
        except RuntimeError as error:
            raised.append(error.args[0])
    assert np.array_equal(np.concatenate(out), wanted)
    assert len(started) > 1 and raised == (started if block < 256_000 else started[:1])


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.slow
def test_in_the_demo_the_human_is_noticed_and_the_robot_is_not(alone):
    names = ("mic", "reference", "human")
    mic, ref, human = (soundfile.read(DATA / f"{name}.flac", dtype="float32")[0] for name in names)
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
