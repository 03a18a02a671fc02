"""The beginning and the end of the human's speech, from probabilities and in the bundled conversation."""

from functools import partial

import numpy as np
import pytest

from edgefilter import EgoFilter
from edgefilter.commands.display import say_event
from edgefilter.engines.linear import Linear
from edgefilter.errors import UsageError
from edgefilter.filter.barge_in import ERROR, FALL, BargeIn, BargeInSettings, human_probability, log_odds
from edgefilter.filter.budget import DEMO
from edgefilter.filter.stream import Stream
from edgefilter.types import SAMPLE_RATE, Event, Output
from tests.program import demo

HOP_S = 0.016
UNSURE = 0.3
THRESHOLD = BargeInSettings().threshold


def interrupted() -> tuple[np.ndarray, np.ndarray]:
    """Microphone and reference from the robot's second utterance on, until the human has spoken for four seconds."""
    return tuple(x[7 * SAMPLE_RATE : 13 * SAMPLE_RATE] for x in demo("mic", "reference"))


def noted(probabilities: list[float | None], settings: BargeInSettings | None = None) -> list[str | None]:
    talk = BargeIn(HOP_S, settings)
    return [talk.note(probability) for probability in probabilities]


def happened(probabilities: list[float | None], settings: BargeInSettings | None = None) -> list[tuple[int, str]]:
    return [(at, what) for at, what in enumerate(noted(probabilities, settings)) if what]


def test_a_moment_is_suspected_and_dismissed_and_a_pause_is_not_the_end_of_speech():
    settings = BargeInSettings(threshold=0.9, release=0.5, min_silence_s=30 * HOP_S)
    assert happened([0.95, 0.9, 0.1, *[None] * 100], settings) == [(0, "speech_suspected"), (2, "speech_dismissed")]
    told = [(0, "speech_suspected"), (2, "speech_started"), (62, "speech_stopped")]
    assert happened([0.95] * 2 + [0.98] + [0.49] * 29 + [0.5] + [0.49] * 30, settings) == told


def test_what_stays_unclear_is_decided_by_its_sum_when_the_time_to_confirm_is_over():
    longest = round(0.3 / HOP_S)
    for then, what in ((0.968, "speech_dismissed"), (0.972, "speech_started")):
        found = happened([0.97, *[then] * longest])
        assert found[:2] == [(0, "speech_suspected"), (longest - 1, what)]


@pytest.mark.parametrize("sure", [0.98, 0.99, 0.999])
def test_without_a_time_to_confirm_the_suspicion_is_the_only_event_and_comes_as_soon(sure):
    said = [0.5, sure, sure, *[0.0] * 100]
    found = happened(said, BargeInSettings(confirm_s=0.0))
    assert [what for _, what in found] == ["speech_started", "speech_stopped"]
    assert found[0][0] == happened(said)[0][0] == 1


@pytest.mark.parametrize(("human", "right"), [(True, "speech_started"), (False, "speech_dismissed")])
def test_of_independent_hops_with_true_odds_no_more_are_decided_wrongly_than_is_stated(human, right):
    odds = np.random.default_rng(0).normal(1.0 if human else -1.0, np.sqrt(2.0), (4000, 18)) + log_odds(THRESHOLD)
    decided = [happened([THRESHOLD, *said])[1] for said in (1.0 / (1.0 + np.exp(-odds))).tolist()]
    assert np.mean([what != right for _, what in decided]) <= 2 * ERROR
    assert np.median([hop for hop, _ in decided]) < 10


def test_where_the_robot_lowers_its_voice_what_is_heard_of_the_lower_one_decides():
    sure, after, longest = [0.99] * 5, 5, round(BargeInSettings.confirm_s / HOP_S)

    def asked(*probabilities, calibrated=False):
        talk = BargeIn(HOP_S, calibrated=calibrated)
        return [(talk.note(probability, heard_after=after), talk.asking) for probability in probabilities]

    for then, what, at in (
        ([0.999] * 3, "speech_started", after),
        ([*[0.5] * 10, 0.999, 0.999], "speech_started", after + 10),  # after a pause
        ([0.5] * 30, "speech_dismissed", after + longest - 1),
        ([*[0.98, 0.5] * 15], "speech_dismissed", after + longest - 1),
    ):
        found = asked(*sure, *then)  # what came before the lower voice was heard does not count
        assert [(i, told) for i, (told, _) in enumerate(found) if told][:2] == [(0, "speech_suspected"), (at, what)]
        assert all(asking for _, asking in found[:at]) and not found[at][1]
    for calibrated, what in ((True, "speech_started"), (False, None)):
        found = asked(*[0.9999] * 3, calibrated=calibrated)
        assert found[-1] == (what, not calibrated)  # what is beyond doubt needs none
    found = asked(0.98, 1e-4)
    assert found[1] == ("speech_dismissed", False)  # what is clearly nobody needs no lower voice
    talk = BargeIn(HOP_S)
    for probability in sure:
        talk.note(probability, heard_after=round(BargeInSettings.confirm_s / HOP_S) + 1)
        assert not talk.asking  # a lower voice would come too late
    assert talk.speaking


def test_a_threshold_is_a_rate_of_false_starts():
    for rate, threshold in ((16.0, 0.97), (9.0, 0.99)):
        assert BargeInSettings.at_rate(rate).threshold == pytest.approx(threshold, abs=0.001)
    asking = BargeInSettings.at_rate(5.0, ask_db=12.0)
    assert asking == BargeInSettings(threshold=324.0 / 325.0, ask_db=12.0)
    for rate in (0.0, -1.0, 90.0, float("nan")):
        with pytest.raises(UsageError, match=f"got {rate} false starts an hour, expected more than 0 and less than 90"):
            BargeInSettings.at_rate(rate)


def suspicions(per_minute: float, minutes: int, robot: bool) -> int:
    """In the latter half of a robot alone that is taken for a human so often, by exponential odds beyond even ones."""
    rng, talk = np.random.default_rng(0), BargeIn(HOP_S)
    hops = round(60 * minutes / HOP_S)
    moments = rng.random(hops) < per_minute * HOP_S / 60
    odds = np.where(moments, rng.exponential(FALL, hops), log_odds(UNSURE))
    told = [talk.note(p, robot=robot) for p in (1.0 / (1.0 + np.exp(-odds))).tolist()]
    return told[hops // 2 :].count("speech_suspected")


def test_a_robot_that_is_often_taken_for_a_human_needs_more_evidence_and_one_that_never_is_less():
    usual, learned = ([suspicions(rate, 60, robot) for rate in (1.5, 15.0)] for robot in (False, True))
    # what it learns is held against as long of a usual robot
    assert usual[1] > 8 * usual[0] and learned[1] < 3 * learned[0]
    assert learned[0] == pytest.approx(usual[0], rel=0.35)  # some 8 each
    for quiet, sooner in ((2 * 7500, True), (0, False)):
        talk = BargeIn(HOP_S)
        for _ in range(quiet):
            talk.note(UNSURE, robot=True)
        assert (talk.note(0.95, robot=True) == "speech_suspected") is sooner


@pytest.mark.parametrize("apart_s", [0.16, 0.24, 0.3, 0.4, 1.0])
def test_a_robot_that_is_taken_for_a_human_all_the_time_is_learned_as_well_as_one_that_pauses(apart_s):
    talk, hops = BargeIn(HOP_S), round(apart_s / HOP_S)
    told = [talk.note(0.05 if i % hops else 0.9995, robot=True) for i in range(round(60 / HOP_S))]
    # 375 where the moments were one that never ended
    assert told.count("speech_suspected") < 50 and talk.own.higher > 3.0


def test_a_robot_lowers_its_voice_once_in_a_second_at_most():
    talk, hops = BargeIn(HOP_S), round(0.19 / HOP_S)
    asking, suspected = [], 0
    for i in range(round(60 / HOP_S)):
        suspected += talk.note(0.05 if i % hops else 0.9999, heard_after=5) == "speech_suspected"
        asking.append(talk.asking)
    begins = np.flatnonzero(np.diff(np.array(asking, int), prepend=0) == 1)
    assert suspected > begins.size > 40 and np.diff(begins).min() * HOP_S >= 1.0 - HOP_S


@pytest.mark.parametrize(
    ("suspected", "lower", "asks_at", "right"),
    [
        (0.985, 0.985, 7, "speech_started"),  # 0.7 of log-odds a hop: from -2.2 to 2.2
        (0.985, 0.3, 7, "speech_dismissed"),
        (0.971, 0.971, None, "speech_dismissed"),
    ],
)
def test_within_a_second_of_a_question_a_robot_asks_again_only_whom_the_sum_believes(suspected, lower, asks_at, right):
    talk = BargeIn(HOP_S)
    first = [talk.note(probability, heard_after=5) for probability in [0.9999] * 5 + [0.05] * 19]
    assert first[0] == "speech_suspected" and first[-1] == "speech_dismissed"
    told, asking = [], []
    for probability in [suspected] * 13 + [lower] * 20:
        told.append(talk.note(probability, heard_after=5))
        asking.append(talk.asking)
    assert [each for each in told if each][:2] == ["speech_suspected", right]
    assert (asking.index(True) if any(asking) else None) == asks_at


def test_what_is_believed_to_be_a_human_is_no_mistake_and_nothing_is_learned_while_the_robot_is_silent():
    pause = [UNSURE] * 60
    for said, robot, slower in (([0.9999] * 60, True, False), ([0.9] * 3, False, False), ([0.9] * 3, True, True)):
        talk = BargeIn(HOP_S)
        for probability in (said + pause) * 20:
            talk.note(probability, robot=robot)
        for _ in range(60):
            talk.note(0.0)  # whoever spoke has ended
        assert (talk.note(THRESHOLD) is None) is slower


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"confirm_s": -1.0}, "confirm_s -1.0 and min_silence_s 0.5, expected seconds"),
        ({"confirm_s": float("inf")}, "confirm_s inf"),
        ({"threshold": 1.0}, "release 0.4 and threshold 1.0, expected probabilities"),
        ({"release": 0.98}, "release 0.98 and threshold 0.97"),
        ({"release": 0.0}, "release 0.0"),
        ({"threshold": float("nan")}, "threshold nan"),
        ({"min_silence_s": -1.0}, "min_silence_s -1.0, expected seconds"),
        ({"ask_db": -1.0}, "ask_db -1.0, expected decibels, 0 or more"),
        ({"judge": "me"}, "judge 'me', expected one of engine, network"),
    ],
)
def test_settings_that_mean_nothing_are_one_line(settings, message):
    with pytest.raises(UsageError, match=message):
        BargeInSettings(**settings)


def test_one_sure_hop_interrupts_no_robot():
    assert happened([UNSURE] * 9 + [1.0] + [UNSURE] * 9) == [(9, "speech_suspected"), (10, "speech_dismissed")]


def test_who_interrupts_again_and_again_is_noticed_each_time_as_soon():
    pause, words = [human_probability(UNSURE)] * 125, [human_probability(0.9995)] * 60
    begins = [at for at, what in happened([*pause, *words] * 12) if what == "speech_started"]
    assert [at % 185 - 125 for at in begins] == [begins[0] - 125] * 12 and begins[0] - 125 < 5


@pytest.mark.slow
@pytest.mark.parametrize("calibrated", [True, False])
def test_the_first_sounds_of_a_robot_whose_lag_is_not_found_yet_are_nobody(calibrated):
    mic, ref = demo("mic", "reference")
    ego, highest, heard = EgoFilter(DEMO / "profile.npz" if calibrated else None, engine="crnn"), 0.0, 0.0
    for at in range(0, ref.size, ego.hop):
        ego.process(mic[at : at + ego.hop], ref[at : at + ego.hop])
        if any(event.kind == "realigned" for event in ego.events()):
            break
        highest = max(highest, ego.speech_probability or 0.0)
        heard = max(heard, float(np.abs(mic[at : at + ego.hop]).max()))
    assert heard > 0.3 * np.abs(mic).max()
    assert highest < 0.5 * THRESHOLD


@pytest.mark.parametrize("probability", [0.0, 1e-30, 1.0])
def test_probabilities_stay_in_0_to_1_whatever_comes(probability):
    assert 0.0 <= human_probability(probability) <= 1.0


def test_an_engine_without_a_network_gives_no_probability_and_no_events():
    ego = EgoFilter(DEMO / "profile.npz", engine="ss")
    ego.process(*interrupted())
    assert ego.speech_probability is None and not ego.human_speaks
    assert not [event for event in ego.events() if event.kind.startswith("speech")]


def test_the_network_can_judge_beside_the_linear_stage_and_changes_nothing_of_its_sound():
    mic, ref = (x[:SAMPLE_RATE] for x in demo("mic", "reference"))
    network, found = BargeInSettings(judge="network"), {}
    for name, engine, settings in (
        ("linear", "linear", None),
        ("judged", "linear", network),
        ("crnn", "crnn", network),
    ):
        ego = EgoFilter(DEMO / "profile.npz", engine=engine, barge_in=settings)
        out = [ego.process(mic[at : at + 256], ref[at : at + 256]) for at in range(0, mic.size, 256)]
        found[name] = np.concatenate(out), ego.speech_probability, ego
    assert np.array_equal(found["judged"][0], found["linear"][0])
    assert found["judged"][1] == found["crnn"][1] and found["linear"][1] is None
    stats = found["judged"][2].stats()
    assert stats["engine"] == "linear" and stats["model"] == found["crnn"][2].stats()["model"]


def test_a_budget_that_changes_no_engine_beside_the_network_as_judge_is_no_secret():
    network = BargeInSettings(judge="network")
    for engine in ("crnn", "ss"):
        reason = EgoFilter(engine=engine, budget_ms=0.001, barge_in=network).stats()["engine_reason"]
        assert "a budget of 0.001 ms does not change the engine: none is cheaper than the network" in reason
    for free in (EgoFilter(engine="ss", barge_in=network), EgoFilter(engine="ss", budget_ms=0.001)):
        assert "budget" not in free.engine_reason


def test_engines_that_take_other_frames_cannot_judge_for_one_another():
    network = BargeInSettings(judge="network")
    with pytest.raises(UsageError, match="crnn cannot judge speech for bypass: its front is full, expected none"):
        EgoFilter(engine="bypass", barge_in=network)


@pytest.mark.slow
def test_who_gives_callbacks_is_called_at_the_suspicion_and_at_the_beginning_and_the_settings_reach_the_stream():
    found = {}
    for confirm_s in (0.3, 0.0):
        begun: list[Event] = []
        suspected: list[Event] = []
        called = {"on_barge_in": begun.append, "on_suspicion": suspected.append}
        settings = BargeInSettings(confirm_s=confirm_s)
        ego = EgoFilter(DEMO / "profile.npz", engine="crnn", barge_in=settings, **called)
        ego.process(*interrupted())
        events = ego.events()
        assert begun and begun == [event for event in events if event.kind == "speech_started"]
        assert suspected == [event for event in events if event.kind in ("speech_suspected", "speech_dismissed")]
        found[confirm_s] = begun[0].sample, suspected
    assert not found[0.0][1] and found[0.3][1][0].sample == found[0.0][0]
    assert 0 < found[0.3][0] - found[0.0][0] < 0.3 * SAMPLE_RATE


class Loud(Linear):
    """Takes a microphone above -30 dBFS for a human, so that the robot is one unless it lowers its voice."""

    def step(self, frame, state):
        rms = np.sqrt(np.mean(np.abs(frame.mic) ** 2) / self.stft.window_length)
        return Output(frame.mic, 0.9999 if rms > 10 ** (-30 / 20) else 0.0001), state


@pytest.mark.slow
@pytest.mark.parametrize(("human", "right"), [(False, "speech_dismissed"), (True, "speech_started")])
def test_a_robot_that_asks_tells_its_own_voice_from_a_human_by_lowering_it(human, right):
    """A closed loop: a player that follows the gain, 100 ms before the microphone hears it."""
    ref = (0.02 * np.random.default_rng(0).standard_normal(4 * SAMPLE_RATE)).astype(np.float32)
    ref[2 * SAMPLE_RATE :] *= 10.0  # from here on loud enough to be taken for a human
    lag, hop = 1600, 256
    mic = 0.5 * np.concatenate((np.zeros(lag, np.float32), ref))[: ref.size]
    stream = Stream(Loud(), barge_in=BargeInSettings(ask_db=12.0))
    gains = np.ones(ref.size + hop, np.float32)
    for at in range(0, ref.size - hop, hop):
        gains[at : at + hop] = stream.voice_gain
        heard = mic[at : at + hop] * gains[np.maximum(np.arange(at, at + hop) - lag, 0)]
        stream.process(mic[at : at + hop] if human else heard, ref[at : at + hop] * gains[at : at + hop])
    kinds = [event.kind for event in stream.events if event.kind.startswith(("speech", "voice"))]
    first = kinds.index("speech_suspected")
    assert kinds[first : first + 2] == ["speech_suspected", "voice_gain"]
    assert right in kinds and (human or "speech_started" not in kinds)
    lowered = [event.detail for event in stream.events if event.kind == "voice_gain"]
    assert lowered[:2] == ["0.251", "1.000"]


class Moments(Linear):
    """Takes 0.64 s of anything for a human once, not surely, and what is heard from 12 s on more surely."""

    def __init__(self):
        super().__init__()
        self.hop = 0

    def step(self, frame, state):
        self.hop += 1
        said = 0.98 if self.hop % 40 == 0 else 0.1
        return Output(frame.mic, 0.9985 if self.hop > 750 else said), state


@pytest.mark.slow
@pytest.mark.parametrize("talks", [True, False])
def test_a_stream_learns_from_the_robot_s_own_voice_and_from_no_other_sound(talks):
    ref = (0.1 * np.random.default_rng(0).standard_normal(13 * SAMPLE_RATE)).astype(np.float32)
    mic = 0.5 * np.concatenate((np.zeros(1600, np.float32), ref))[: ref.size]
    stream = Stream(Moments())
    stream.process(mic, ref if talks else np.zeros_like(ref))
    assert any(event.kind == "speech_started" for event in stream.events) is not talks


@pytest.mark.slow
def test_a_callback_that_raises_costs_no_sample():
    """256000 samples went in and 248320 came out."""
    mic, ref = interrupted()
    settings = BargeInSettings(min_silence_s=0.1)  # speech begins several times
    usual = EgoFilter(DEMO / "profile.npz", engine="crnn", barge_in=settings)
    wanted = np.concatenate((usual.process(mic, ref), usual.flush()))
    started = [event.sample for event in usual.events() if event.kind == "speech_started"]

    def fail(event: Event) -> None:
        raise RuntimeError(event.sample)

    for block in (255, mic.size):
        ego, out, raised = EgoFilter(DEMO / "profile.npz", engine="crnn", barge_in=settings, on_barge_in=fail), [], []
        blocks = [(mic[at : at + block], ref[at : at + block]) for at in range(0, mic.size, block)]
        for call in (*(partial(ego.process, *each) for each in blocks), ego.flush, ego.flush):
            try:
                out.append(call())
            except RuntimeError as error:
                raised.append(error.args[0])
        assert np.array_equal(np.concatenate(out), wanted), block
        assert len(started) > 1 and raised == (started if block < mic.size else started[:1]), block


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.slow
def test_in_the_demo_the_human_is_noticed_and_the_robot_is_not(alone):
    mic, ref, human = demo("mic", "reference", "human")
    ego = EgoFilter(DEMO / "profile.npz", engine="crnn")
    ego.process(mic - alone * human, ref)
    talk = [event for event in ego.events() if event.kind.startswith("speech")]
    if alone:
        assert not talk and not ego.human_speaks
        return
    assert [event.kind for event in talk] == ["speech_suspected", "speech_started", "speech_stopped"]
    talk = talk[1:]
    power = np.square(human[: human.size // 320 * 320]).reshape(-1, 320).mean(1)
    first, last = np.flatnonzero(power > 10**-2.5 * power.max())[[0, -1]] * 320
    assert first < talk[0].sample < first + 0.5 * SAMPLE_RATE
    assert last < talk[1].sample < last + 2 * SAMPLE_RATE


def test_a_live_run_says_when_somebody_speaks_and_a_recording_does_not(capsys):
    for live in (True, False):
        say_event(Event("speech_started", 24000, "probability 0.97"), live=live)
    assert capsys.readouterr().err == "1.5 s: speech started probability 0.97\n"


def test_a_human_beside_a_robot_that_plays_unheard_is_noticed_at_once():
    """Into headphones, say: the microphone is silent, digitally, until somebody speaks."""
    robot, human = demo("reference", "human")
    robot = np.tile(robot[: 3 * SAMPLE_RATE], 2)
    first = int(np.argmax(np.abs(human) > 0.01))
    mic, begins = np.zeros_like(robot), 3 * SAMPLE_RATE
    mic[begins:] = 10 * human[first : first + mic.size - begins]
    ego = EgoFilter(engine="crnn")
    ego.process(mic, robot)
    noticed = [event.sample for event in ego.events() if event.kind == "speech_started"]
    assert len(noticed) == 1 and 0 <= noticed[0] - begins < SAMPLE_RATE // 4


def test_without_a_least_silence_the_first_silent_hop_ends_the_speech():
    told = ["speech_started", "speech_stopped", "speech_started"]
    assert noted([0.99, 0.0, 0.99], BargeInSettings(confirm_s=0.0, min_silence_s=0.0)) == told


def test_at_the_end_of_a_recording_speech_is_over_and_the_next_begins_anew():
    talk = BargeIn(HOP_S, BargeInSettings(min_silence_s=2 * HOP_S))
    assert [talk.note(0.9999) for _ in range(2)] == ["speech_suspected", "speech_started"]
    assert talk.end() == "speech_stopped" and not talk.speaking and talk.end() is None
    assert talk.note(0.99) == "speech_suspected" and talk.end() == "speech_dismissed"
    told = ["speech_suspected", "speech_started", None, "speech_stopped"]
    assert [talk.note(each) for each in (0.9999, 0.9999, 0.0, 0.0)] == told


def test_how_long_a_beginning_was_not_told_is_known_when_it_is():
    talk = BargeIn(HOP_S)
    assert [talk.note(0.9999, wait=3) for _ in range(4)][-1] == "speech_started" and talk.waited == 3
    talk.end()
    assert [talk.note(0.9999) for _ in range(2)][-1] == "speech_started" and talk.waited == 1


def test_what_had_to_wait_is_tested_on_what_follows():
    """Sound that is found to be the robot's as soon as the lag is known, which also ends the waiting."""
    talk = BargeIn(0.016)
    assert not any(talk.note(0.9999, wait=30) for _ in range(20))
    told = [talk.note(0.0) for _ in range(30)]
    assert [each for each in told if each] == ["speech_suspected", "speech_dismissed"] and not talk.speaking
    assert not any(talk.note(0.9999, wait=30) for _ in range(20))
    assert [talk.note(each) for each in (0.0, 0.9999)] == ["speech_suspected", "speech_started"]


def test_once_the_lag_is_known_the_robot_may_be_asked_and_what_is_heard_of_the_lower_voice_decides():
    talk, after = BargeIn(HOP_S, calibrated=True), 5
    assert not any(talk.note(0.9999, wait=30) for _ in range(20)) and not talk.asking
    told = [(talk.note(p, heard_after=after), talk.asking) for p in (*[0.9] * (after + 1), *[0.0] * 30)]
    assert [(at, what) for at, (what, _) in enumerate(told) if what][0] == (0, "speech_suspected")
    assert all(asking for _, asking in told[: after + 1])
    assert [what for what, _ in told if what][1:] == ["speech_dismissed"] and not talk.asking
