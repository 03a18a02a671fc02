"""A reference that is late, missing, or another sound: it is said, and no robot is taken for somebody because of it."""

import re

import numpy as np
import pytest
from scipy import signal

from edgefilter import EgoFilter
from edgefilter.alignment.aligner import Aligned, Past
from edgefilter.alignment.belief import Belief
from edgefilter.alignment.delay_line import DelayBuffer
from edgefilter.alignment.utterances import OnsetDetector
from edgefilter.filter.barge_in import BargeIn
from edgefilter.filter.playback_faults import AHEAD, BEHIND, CHANCE, LENGTH, speeds
from edgefilter.filter.reference_watch import ReferenceWatch
from edgefilter.filter.removal import Removal
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SET_UP_WRONG, Frame
from edgefilter.types import SAMPLE_RATE as RATE
from tests.program import DEMO, demo

LAG = 2288
"""Samples after which the microphone of the bundled conversation hears the reference's first utterance."""


@pytest.fixture(scope="module")
def robot():
    """The bundled robot alone: microphone and reference, 9 s."""
    return [x[: 9 * RATE] for x in demo("mic", "reference")]


def later(x, samples):
    return np.concatenate((np.zeros(samples, np.float32), x))[: x.size]


def events(ego, mic, ref, block=256):
    for at in range(0, mic.size, block):
        ego.process(mic[at : at + block], ref[at : at + block])
    return ego.events()


def faults(mic, ref, ego=None):
    """What is said to be set up wrongly; ego: None for the linear stage alone, without a profile."""
    return [event for event in events(ego or EgoFilter(engine="linear"), mic, ref) if event.kind in SET_UP_WRONG]


@pytest.mark.slow
@pytest.mark.parametrize("profile", [None, DEMO / "profile.npz"], ids=["no profile", "profile"])
@pytest.mark.parametrize("late_ms", [60, 157, 300])
def test_a_robot_whose_reference_is_late_is_not_taken_for_somebody_and_the_lateness_is_said(robot, profile, late_ms):
    mic, ref = robot
    found = events(EgoFilter(profile, engine="crnn"), mic, later(ref, LAG + 16 * late_ms))
    assert "speech_started" not in {event.kind for event in found}
    (late,) = (event for event in found if event.kind == "reference_late")
    assert f"comes {late_ms} ms after" in late.detail or f"comes {late_ms - 1} ms after" in late.detail
    assert late.sample < 1.5 * RATE  # half a second after the reference has begun, the latest of which does at 0.9 s


@pytest.mark.slow
def test_a_reference_in_time_is_said_nothing_of_and_the_human_is_noticed_as_before():
    mic, ref = demo("mic", "reference")
    found = events(EgoFilter(DEMO / "profile.npz", engine="crnn"), mic, ref)
    assert not {event.kind for event in found} & set(SET_UP_WRONG)
    (began,) = (event for event in found if event.kind == "speech_started")
    assert 9.1 < began.sample / RATE < 9.6


def test_a_sentence_said_again_while_its_first_echo_still_sounds_is_no_late_reference(robot):
    _, ref = robot
    sentence, pause = ref[RATE : RATE + 25_600], np.zeros(6_400, np.float32)
    said = np.concatenate(
        (pause, *(part for _ in range(4) for part in (sentence, pause)), np.zeros(2 * RATE, np.float32))
    )
    fan = 1e-4 * np.random.default_rng(0).standard_normal(said.size).astype(np.float32)
    profile = Profile.load(DEMO / "profile.npz")
    found = events(EgoFilter(profile, engine="linear"), later(profile.echo.predict(said), 19_200) + fan, said)
    assert "realigned" in {event.kind for event in found}
    assert not {event.kind for event in found} & set(SET_UP_WRONG)


def another_agent(said):
    """A second robot talks at once, as loud, in no reference."""
    return said, np.roll(said[::-1], RATE)


def music(said):
    """The reference holds music under the voice: chords of half a second."""
    notes = 220.0 * 2 ** (np.random.default_rng(0).integers(0, 24, (said.size // 8000, 3)) / 12)
    phase = 2 * np.pi * np.cumsum(np.repeat(notes, 8000, axis=0) / RATE, axis=0)
    return said + (0.3 * np.std(said) * np.sin(phase).sum(axis=1)).astype(np.float32), 0 * said


def echo_bot(said):
    """The robot says everything again that a human beside it has just said: 1.5 s of words, 2 s later."""
    words = said * (np.arange(said.size) // 24_000 % 3 == 1)
    return later(words, 32_000), words


@pytest.mark.parametrize("scene", [another_agent, music, echo_bot])
def test_the_lag_is_found_and_nothing_is_said_to_be_wrong_with(scene, robot):
    said, beside = scene(np.tile(robot[1], 2)[: 15 * RATE])
    echo = later(Profile.load(DEMO / "profile.npz").echo.predict(said), 3_000 - PRE_ROLL)
    heard = echo + np.std(echo) / np.std(said) * beside  # as loud as the robot
    heard += 1e-4 * np.random.default_rng(0).standard_normal(said.size).astype(np.float32)
    ego = EgoFilter(engine="linear")
    assert not faults(heard, said, ego)
    assert ego.stats()["alignment"]["delay_samples"] == pytest.approx(3_000, abs=40)


@pytest.mark.parametrize("late", [0, 128])
def test_the_microphone_waits_for_a_reference_that_comes_some_milliseconds_late(robot, late):
    mic, ref = (x[: 5 * RATE] for x in robot)
    ego = EgoFilter(engine="linear")
    out = np.append(ego.process(mic, later(ref, LAG + late)), ego.flush())
    before, left = (float(np.mean(np.square(x[3 * RATE :]))) for x in (mic, out))
    assert 10 * np.log10(before / left) > 24.0  # 27 dB where the reference is 4 ms early; without waiting 20 and 2
    assert not {event.kind for event in ego.events()} & set(SET_UP_WRONG)


@pytest.mark.slow
def test_a_late_reference_that_is_mended_is_forgotten(robot):
    mic, ref = robot
    ego = EgoFilter(DEMO / "profile.npz", engine="crnn")
    assert "reference_late" in {event.kind for event in events(ego, mic, later(ref, LAG + 4800))}
    found = events(ego, *demo("mic", "reference"))
    began = [event.sample / RATE - 9 for event in found if event.kind == "speech_started"]
    assert len(began) == 1 and 9.1 < began[0] < 9.8, "the human is noticed beside the robot"


def test_somebody_who_speaks_before_the_robot_ever_did_is_noticed_half_a_second_later():
    """Until the reference was seen to come in time, what begins while it is silent may be the robot."""
    human = demo("human")[0][9 * RATE : 13 * RATE]
    rng = np.random.default_rng(0)
    mic = np.concatenate((np.zeros(RATE), 10 * human)).astype(np.float32)
    mic += (1e-3 * rng.standard_normal(mic.size)).astype(np.float32)
    found = [event for event in events(EgoFilter(engine="crnn"), mic, 0 * mic) if event.kind == "speech_started"]
    assert len(found) == 1 and 1.5 * RATE < found[0].sample < 2.5 * RATE


@pytest.mark.slow
def test_another_sound_than_the_loudspeaker_s_is_said(robot):
    mic, ref = robot
    quiet = (1e-4 * np.random.default_rng(2).standard_normal(2 * RATE)).astype(np.float32)
    other = np.concatenate((0 * quiet, ref[::-1], ref[::-1]))
    wrong = faults(np.concatenate((quiet, mic, mic)), other)
    assert [event.kind for event in wrong] == ["robot_unfound"] and "dB louder" in wrong[0].detail


@pytest.mark.parametrize(
    ("heard", "played", "within"),
    [("robot", "another", 5.0), ("turns", "another", None), ("robot", "noise", None)],
    ids=["another reference", "a human who speaks in turn with a robot in headphones", "the noise of a loopback"],
)
def test_what_is_heard_while_the_reference_plays_is_another_sound_within_five_seconds_of_it(
    robot, heard, played, within
):
    mic, ref = (x[RATE : 6 * RATE] for x in robot)
    noise = np.random.default_rng(7).standard_normal(2 * ref.size).astype(np.float32)
    other = 1e-4 * noise if played == "noise" else np.tile(np.roll(ref[::-1], RATE), 2)
    mic = np.tile(mic, 2)
    if heard == "turns":
        mic = mic * (signal.oaconvolve(np.abs(other) > 1e-3, np.ones(RATE), "same") < 0.5)
    found = faults(mic + 1e-4 * noise[::-1], other)
    assert [event.kind for event in found] == ["robot_unfound"] * (within is not None)
    assert not found or found[0].sample < within * RATE


@pytest.mark.slow
def test_a_robot_that_plays_unheard_is_no_mistake(robot):
    _, ref = robot
    rng = np.random.default_rng(2)
    mic = (1e-3 * rng.standard_normal(2 * RATE + 2 * ref.size)).astype(np.float32)
    assert not faults(mic, np.concatenate((np.zeros(2 * RATE, np.float32), ref, ref)))


@pytest.mark.slow
@pytest.mark.parametrize(("level", "said"), [(0.1, 1), (1e-5, 0)], ids=["sound", "silence"])
def test_a_reference_that_never_comes_is_said_once_where_something_is_heard(level, said):
    mic = (level * np.random.default_rng(3).standard_normal(70 * RATE)).astype(np.float32)
    found = events(EgoFilter(engine="linear"), mic, 0 * mic, block=RATE)
    wrong = [event for event in found if event.kind in SET_UP_WRONG]
    assert [event.kind for event in wrong] == ["reference_missing"] * said


def test_speech_that_waits_is_told_once_it_may_be_and_never_if_it_has_ended():
    talk = BargeIn(0.1)
    assert [talk.note(0.999, wait=3) for _ in range(5)] == [None, None, None, "speech_started", None]
    assert [talk.note(0.0, wait=3) for _ in range(6)].count("speech_stopped") == 1
    assert [talk.note(p, wait=30) for p in (*[0.999] * 2, *[0.0] * 6, 0.5)] == [None] * 9 and not talk.speaking
    assert talk.note(0.999, wait=0) == "speech_suspected"


def test_a_microphone_that_is_processed_is_said_and_a_good_one_is_not(robot):
    """A gate that opens by itself and noise as loud as the robot leave nothing to predict."""
    mic, ref = robot
    ego = EgoFilter(engine="linear")
    assert not faults(mic, ref, ego)
    assert ego.stats()["linear_stage"]["removed_db"] > 10.0
    rng = np.random.default_rng(4)
    scrambled = np.abs(mic) * rng.choice((-1.0, 1.0), mic.size).astype(np.float32)  # the envelope is all that is left
    ego = EgoFilter(engine="linear")
    processed = 0.5 * mic + 0.7 * scrambled
    wrong = faults(np.tile(processed, 2), np.tile(ref, 2), ego)
    assert [event.kind for event in wrong] == ["echo_unpredicted"] and "switch off" in wrong[0].detail
    assert wrong[0].sample < 12 * RATE
    assert ego.stats()["linear_stage"]["removed_db"] < 4.0


def test_a_profile_of_another_scale_is_no_microphone_that_is_processed(robot):
    """80 dB louder than the microphone until the first words have told the scale, the echo seemed to be unpredicted."""
    mic, ref = robot
    ego = EgoFilter(DEMO / "profile.npz", engine="linear")
    assert not faults(0.01 * mic, 100 * ref, ego)
    assert ego.stats()["linear_stage"]["removed_db"] > 20.0


SILENT_FRAME = Frame(*np.zeros((4, 1601), np.complex64), *np.zeros((2, 1601), np.float32))


def watched(*parts, removal=None):
    """What is said, and when, s, of a silent reference; parts: (seconds, rms of the microphone, state of the aligner)."""
    watch, silence, now, said = ReferenceWatch(1600, 1601), np.zeros(1600, np.float32), 0.0, []
    for seconds, rms, state in parts:
        aligned = Aligned(silence, 0.0 if state == "locked" else float("nan"), 0.0, 0.0, state, False)
        for _ in range(round(10 * seconds)):
            now += 0.1
            heard = np.full(1600, rms, np.float32)
            found = watch.step(heard, silence, aligned, SILENT_FRAME, removal or Removal(1600), False)
            said += [(kind, round(now, 1)) for kind, _ in found]
    return said


@pytest.mark.parametrize(
    ("parts", "at"),
    [
        ([(70.0, 1.1e-3)], 60.0),
        ([(70.0, 0.9e-3)], None),
        ([(10.0, 1.1e-3), (60.0, 0.0)], 60.0),
        ([(9.9, 1.1e-3), (60.0, 0.0)], None),
        ([(61.0, 0.0), (10.0, 1.1e-3)], 71.0),
    ],
)
def test_a_reference_is_missing_after_a_minute_in_which_ten_seconds_were_louder_than_60_db_below_full_scale(parts, at):
    assert watched(*((*part, "idle") for part in parts)) == ([("reference_missing", at)] if at else [])


def test_a_reference_that_has_come_once_is_not_missing_however_long_it_is_silent_then():
    watch, hop = ReferenceWatch(1600, 1601), np.full(1600, 0.01, np.float32)
    aligned = Aligned(hop, float("nan"), 0.0, 0.0, "idle", False)
    for number in range(900):
        said = watch.step(hop, hop if number == 5 else 0 * hop, aligned, SILENT_FRAME, Removal(1600), False)
        assert "reference_missing" not in {kind for kind, _ in said}


class LittleRemoved(Removal):
    removed_db = 0.5


@pytest.mark.parametrize("unpredicted", [True, False])
def test_an_echo_of_which_hardly_anything_is_removed_is_said_once(unpredicted):
    removal = LittleRemoved(1600)
    removal.unpredicted = unpredicted
    said = [kind for kind, _ in watched((1.0, 1e-2, "locked"), removal=removal)]
    assert said == ["echo_unpredicted"] * unpredicted


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-4], ids=["silent", "noise of a loopback"])
def test_a_reference_that_falls_silent_while_the_robot_is_heard_on_is_said_and_the_robot_is_nobody(robot, noise):
    mic, ref = (np.tile(x, 4) for x in robot)
    ref[9 * RATE :] = noise * np.random.default_rng(5).standard_normal(ref.size - 9 * RATE)
    found = [event for event in events(EgoFilter(engine="crnn"), mic, ref) if event.sample > 9 * RATE]
    (missing,) = (event for event in found if event.kind in SET_UP_WRONG)
    assert missing.kind == "reference_missing" and "sounds like the robot" in missing.detail
    assert missing.sample < 15 * RATE  # the robot talks for 5 s from 10 s on
    assert not [event for event in found if event.kind == "speech_started" and event.sample > missing.sample]


@pytest.mark.slow
def test_somebody_who_talks_at_the_level_of_a_silent_robot_is_not_taken_for_it(robot):
    mic, ref = robot
    human = demo("human")[0][9 * RATE : 13 * RATE]
    human *= np.sqrt(np.mean(mic[RATE : 6 * RATE] ** 2) / np.mean(human**2))
    mic = np.concatenate((mic, np.tile(human, 3)))
    found = events(EgoFilter(engine="crnn"), mic, np.concatenate((ref, np.zeros(3 * human.size, np.float32))))
    assert not {event.kind for event in found} & set(SET_UP_WRONG)
    assert [event for event in found if event.kind == "speech_started" and event.sample > 9 * RATE]


@pytest.mark.parametrize(("shift", "noise"), [(0, 0.0), (1, 0.0), (0, 2e-3)], ids=["same", "a sample later", "noise"])
def test_one_signal_given_for_both_is_said_and_a_loudspeaker_beside_the_microphone_is_not(robot, shift, noise):
    _, ref = robot
    heard = later(0.3 * ref, shift) + (noise * np.random.default_rng(6).standard_normal(ref.size)).astype(np.float32)
    assert [event.kind for event in faults(heard, ref)] == ["same_signal"] * (not shift and not noise)


def test_a_late_reference_asks_whether_both_are_swapped(robot):
    mic, ref = robot
    (late,) = (event for event in faults(ref, mic) if event.kind == "reference_late")
    assert "swapped" in late.detail


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 7])
def test_a_linear_path_is_not_blamed_while_it_is_being_learned(robot, seed):
    """A long reverberation from nothing: 3 dB were removed on average over the first seconds, 30 dB later."""
    rng = np.random.default_rng(seed)
    ref = np.tile(robot[1], 2)
    room = rng.standard_normal(8000) * 10 ** (-3 * np.arange(8000) / (0.6 * RATE))
    room[0] = 3.0
    mic = later(signal.oaconvolve(ref, room)[: ref.size].astype(np.float32), 1920)
    mic += (1e-3 * np.std(mic) * rng.standard_normal(mic.size)).astype(np.float32)
    ego = EgoFilter(engine="linear")
    assert not faults(mic, ref, ego)
    assert ego.stats()["linear_stage"]["removed_db"] > 15.0


@pytest.mark.parametrize("speed", [0.87, 44.1 / 48, 0.97, 0.99, 1.01, 1.05, 48 / 44.1, 1.15])
def test_a_loudspeaker_that_plays_at_another_speed_is_named(robot, speed):
    mic, ref = (x[: 8 * RATE] for x in robot)
    heard = np.interp(LAG + np.arange(mic.size - LAG) * speed, np.arange(mic.size), mic).astype(np.float32)
    heard = np.concatenate((np.zeros(LAG, np.float32), heard))
    said = faults(heard, ref, EgoFilter(engine="crnn"))
    assert [event.kind for event in said] == ["rate_mismatch"] and said[0].sample < 6 * RATE
    percent, way = re.search(r"([\d.]+) % (faster|slower)", said[0].detail).groups()
    assert float(percent) / 100 == pytest.approx(abs(speed - 1.0), abs=0.006)
    assert way == ("faster" if speed > 1.0 else "slower")
    assert ("44.1 kHz" in said[0].detail) == (speed in (48 / 44.1, 44.1 / 48))


def test_a_reference_that_loses_samples_is_named_and_one_whose_lag_changes_with_each_utterance_is_not(robot):
    mic, ref = robot
    kept = np.ones(ref.size, bool)
    for at in range(RATE, ref.size, RATE):
        kept[at : at + 160] = False
    cut = np.concatenate((ref[kept], np.zeros(ref.size - int(kept.sum()), np.float32)))
    said = faults(mic, cut)
    assert [event.kind for event in said] == ["reference_gaps"] and re.search(r"by \d+ ms in \d s;", said[0].detail)
    assert "reference_gaps" not in {event.kind for event in faults(mic, ref)}


def test_a_reference_a_little_after_its_echo_is_told_to_the_millisecond(robot):
    mic, ref = robot
    said = faults(mic, later(ref, LAG + 320))
    assert [event.kind for event in said] == ["reference_late"] and " 20 ms after" in said[0].detail


def test_a_lag_of_nearly_three_seconds_is_found(robot):
    mic, ref = robot
    ego = EgoFilter(engine="linear")
    events(ego, later(mic, round(2.8 * RATE) - LAG), ref)
    assert ego.stats()["alignment"]["delay_samples"] == pytest.approx(2.8 * RATE, abs=40)


@pytest.mark.parametrize(
    ("seconds", "kind"), [(-1.6, "reference_late"), (3.3, "robot_unfound"), (4.0, "robot_unfound")]
)
def test_a_lag_that_is_not_followed_is_told_with_its_length_soon_after_the_robot_is_heard(robot, seconds, kind):
    """It was told after up to 16 s, or never; and the robot's own voice was locked to at a wrong lag later on."""
    moved = round(seconds * RATE) - LAG
    mic, ref = (np.pad(x, (3 * RATE + by, 6 * RATE - by)) for x, by in zip(robot, (moved, 0), strict=True))
    told = faults(mic, ref)
    assert [event.kind for event in told] == [kind]
    assert f"{abs(seconds):.1f} s" in told[0].detail or f"{-1000 * seconds:.0f} ms" in told[0].detail
    assert told[0].sample < (3 + max(seconds, 0.0) + 3) * RATE


def test_an_utterance_that_is_found_in_the_end_is_not_said_to_be_unfound_hop_after_hop():
    watch, hop, onsets = ReferenceWatch(1600, 1601), np.ones(1600, np.float32), OnsetDetector(1600)
    for level in (1e-3, 0.1, 0.1, 0.1, 0.1):
        onsets.step(level * hop)
    nothing = Belief(np.zeros(1, int), np.zeros(1, int), *np.zeros((3, 1)), -20.0)
    begun = Aligned(hop, 0.0, 0.0, 0.0, "begun", False, past=Past(DelayBuffer(1600), DelayBuffer(1600), onsets))
    said = [watch.step(1e-3 * hop, 0.1 * hop, begun, SILENT_FRAME, Removal(1600), False)]
    for aligned in [*[begun._replace(belief=nothing)] * 8, *[begun._replace(state="locked")] * 8]:
        said.append(watch.step(0.1 * hop, 0.1 * hop, aligned, SILENT_FRAME, Removal(1600), False))
    assert [kind for found in said for kind, _ in found] == ["robot_unfound"]


def look(late=0.0, lags=(0, 0, 0, 0)):
    """What is believed of the lag in so many seconds."""
    seconds = len(lags)
    return Belief(
        RATE * np.arange(seconds), np.array(lags), np.ones(seconds), np.full(seconds, late), np.zeros(seconds), 9.0
    )


GROWS, ONCE = look(lags=(0, 300, 600, 900)), look(lags=(0, 0, 0, 300))


@pytest.mark.parametrize(
    ("kind", "looks", "at"),
    [
        ("reference_late", [look(p) for p in (0.999, 0.5, 0.999, 0.001, 0.5, 0.999)], [0, 5]),
        ("reference_gaps", [GROWS, ONCE, GROWS, look(), ONCE, GROWS], [1, 5]),
    ],
)
def test_a_fault_that_has_certainly_ended_is_told_again_when_it_begins_again(kind, looks, at):
    """It was told once in all: a reference that was late, mended, and late again, only the first time."""
    watch, hop, onsets = ReferenceWatch(1600, 1601), np.ones(1600, np.float32), OnsetDetector(1600)
    locked = Aligned(hop, 0.0, 0.0, 0.0, "locked", False, past=Past(DelayBuffer(1600), DelayBuffer(1600), onsets))
    said = [
        watch.step(hop, -hop[::-1], locked._replace(belief=one), SILENT_FRAME, Removal(1600), False) for one in looks
    ]
    assert [[found for found, _ in told].count(kind) for told in said] == [number in at for number in range(len(looks))]


@pytest.mark.parametrize(("found", "told"), [(26, 4), (24, 1)], ids=["for 2.6 s", "for 2.4 s"])
def test_another_speed_is_told_again_after_the_robot_was_followed_at_one_lag_in_between(found, told, monkeypatch):
    monkeypatch.setattr("edgefilter.filter.reference_watch.speeds", lambda mic, ref: iter((None, (1.05, 2.0))))
    watch, hop, onsets, said = ReferenceWatch(1600, 1601), np.ones(1600, np.float32), OnsetDetector(1600), []
    past = Past(DelayBuffer(BEHIND + LENGTH + AHEAD), DelayBuffer(BEHIND + LENGTH + AHEAD), onsets)
    for state in 4 * (["begun"] * 80 + ["locked"] * found):
        for buffer in past[:2]:
            buffer.push(hop)
        onsets.step(hop)
        aligned = Aligned(hop, 0.0, 0.0, 0.0, state, False, past=past)
        said += watch.step(hop, -hop[::-1], aligned, SILENT_FRAME, Removal(1600), False)
    assert [kind for kind, _ in said].count("rate_mismatch") == told


def test_where_hardly_anything_sounds_a_speed_is_not_clear_beyond_all_bounds():
    """Nothing was anywhere else, and the ratio to it 4e10."""
    mic, ref = np.zeros(LENGTH, np.float32), np.zeros(BEHIND + LENGTH + AHEAD, np.float32)
    mic[-3000:], ref[-3000:] = np.random.default_rng(0).standard_normal((2, 3000)) / 10
    *_, (_, clear) = speeds(mic, ref)
    assert clear < 1.0 / CHANCE**2
