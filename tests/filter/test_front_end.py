"""What the front end does to every spectrum."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from edgefilter import enhance
from edgefilter.alignment.aligner import Aligned, Aligner
from edgefilter.alignment.delay_line import WAIT
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.linear import Linear
from edgefilter.filter.budget import DEMO
from edgefilter.filter.echo_path import PathState, PathUpdate
from edgefilter.filter.front_end import RUMBLE, Centred, FrontEnd
from edgefilter.filter.residual_echo import Residual
from edgefilter.session import level_db
from edgefilter.types import SAMPLE_RATE, Output
from tests.conformance import robot
from tests.program import demo


def test_without_a_profile_rumble_is_lowered_and_with_one_it_is_as_it_was():
    """A room at 40 Hz under a voice at 400 Hz; the robot is silent."""
    t = np.arange(2 * SAMPLE_RATE) / SAMPLE_RATE
    rumble, voice = ((0.1 * np.sin(2 * np.pi * hz * t)).astype(np.float32) for hz in (40, 400))
    steady = slice(SAMPLE_RATE // 2, -SAMPLE_RATE // 2)
    for profile, left in ((None, RUMBLE), (robot(), 1.0)):
        out = enhance(rumble + voice, np.zeros(t.size, np.float32), profile, engine="linear")[steady]
        for tone, gain in ((rumble, left), (voice, 1.0)):
            found = float(out.dot(tone[steady]) / tone[steady].dot(tone[steady]))
            assert abs(found - gain) < 0.05, (gain, found)  # a window's main lobe reaches 60 Hz beyond the tone


def test_all_spectra_of_a_frame_lose_the_same_rumble():
    """A mask is a ratio of them; one of them alone would be a wrong mask."""
    front, noise = FrontEnd(Linear(), None), np.random.default_rng(0).standard_normal(512).astype(np.float32)
    for hop in noise.reshape(2, -1):
        frame, _ = front.step(hop, 0 * hop)
    assert np.array_equal(frame.mic, frame.error)
    assert np.abs(frame.mic[0]) < 0.1 * np.abs(frame.mic[3:]).max()


@pytest.mark.parametrize(("hop", "microphones"), [(256, None), (128, None), (128, 2)])
def test_a_microphone_that_waits_is_late_by_so_much_however_short_the_hops_are(hop, microphones):
    stft = StftConfig(512, hop, 512, "hann")
    mic = (
        np.random.default_rng(0).standard_normal((*([microphones] if microphones else []), 20 * hop)).astype(np.float32)
    )
    for wait in (0, 40, WAIT):
        front = FrontEnd(Linear(stft), None, microphones=microphones)
        hops = [front._waiting(mic[..., at : at + hop], wait) for at in range(0, mic.shape[-1], hop)]
        heard = np.concatenate(hops, axis=-1)
        np.testing.assert_array_equal(heard[..., wait:], mic[..., : mic.shape[-1] - wait])
        assert not heard[..., :wait].any()


def test_a_frame_says_whether_nothing_of_the_robot_can_be_heard():
    """Silent for a second, speaking for two, silent for three."""
    front, second = FrontEnd(Linear(), robot()), SAMPLE_RATE // 256
    ref = np.zeros(6 * second * 256, np.float32)
    ref[second * 256 : 3 * second * 256] = 0.1 * np.random.default_rng(0).standard_normal(2 * second * 256)
    mic = 0.5 * np.roll(ref, 1600)
    hops = zip(mic.reshape(-1, 256), ref.reshape(-1, 256), strict=True)
    idle = np.array([front.step(*hop)[0].idle for hop in hops])
    assert idle[:second].all() and not idle[second : 3 * second + 7].any() and idle[-second:].all()


def test_the_noise_is_found_again_after_a_microphone_was_muted_from_the_beginning_or_later():
    """An estimate that only grows by a factor could never rise from zero."""
    stft, rng = Linear().stft, np.random.default_rng(0)
    residual, silence = Residual(stft), np.zeros(stft.bins, np.float32)

    def expected(hops: int, level: float) -> float:
        for _ in range(hops):
            error = level * (rng.standard_normal(stft.bins) + 1j * rng.standard_normal(stft.bins)).astype(np.complex64)
            noise, _ = residual.step(silence.astype(np.complex64), error, silence)
        return float(noise.mean())

    assert expected(4000, 0.0) < 0.5e-8
    before = expected(2000, 1e-4)
    assert before > 0.5 * 2e-8
    assert expected(4000, 0.0) < 1e-4 * before
    assert expected(6000, 1e-4) > 0.5 * before


class Forgetting:
    """Hands over a path that holds nothing, after twenty hops."""

    def __init__(self):
        self.hops = 0

    def start(self, path, hop):
        nothing = replace(path.canceller, weights=0 * path.canceller.weights)
        self.update = PathUpdate(PathState(path.effects, nothing), "learned", "nothing")

    def observe(self, hop):
        self.hops += 1
        return self.update if self.hops == 20 else None


def test_a_lesson_is_faded_in_over_the_hop_in_which_it_is_adopted():
    plain, taught = FrontEnd(Linear(), robot()), FrontEnd(Linear(), robot(), Forgetting())
    ref = (0.1 * np.random.default_rng(0).standard_normal((40, 256))).astype(np.float32)
    mic = 0.5 * np.roll(ref.ravel(), 900).reshape(ref.shape)
    for hop in zip(mic, ref, strict=True):
        for front in (plain, taught):
            front.step(*hop)
            front.linear_stage.learn()
        if taught.linear_stage.update:
            break
        np.testing.assert_allclose(taught.linear.echo, plain.linear.echo, atol=1e-6)  # the past is read in other pieces
    assert np.abs(plain.linear.echo).max() > 0.05
    np.testing.assert_allclose(taught.linear.echo, np.linspace(1.0, 0.0, 256) * plain.linear.echo, atol=1e-6)
    assert np.array_equal(taught.linear.error, taught.heard - taught.linear.echo)


class Scripted(Aligner):
    """Says what it is told to of each hop, of a reference that is not late."""

    def __init__(self, *states: str) -> None:
        super().__init__(256)
        self.states = iter(states)

    def step(self, mic, ref):
        state = next(self.states)
        return Aligned(ref, 0.0, 0.0, 1.0, state.removesuffix("!"), False, at_any_lag=state.endswith("!"))


def scripted(*states: str, learner=None) -> tuple[FrontEnd, list]:
    """A front end that has stepped through these states, and its frames; the microphone hears the reference by half."""
    front = FrontEnd(Linear(), robot(), learner, aligner=Scripted(*states))
    hops = 0.1 * np.random.default_rng(0).standard_normal((len(states), 256)).astype(np.float32)
    frames = []
    for hop in hops:
        frames.append(front.step(0.5 * hop, hop)[0])
        front.linear_stage.learn()
    return front, frames


def test_a_frame_may_hold_the_robot_at_any_lag_where_one_of_its_two_hops_may():
    _, frames = scripted("locked", "begun!", "locked", "locked", "unfound!")
    assert [frame.at_any_lag for frame in frames] == [False, True, True, False, True]


@pytest.mark.parametrize("state", ["begun", "announced", "locked", "coarse", "lost"])
def test_the_path_is_learned_only_where_the_reference_is_known_to_lie_where_it_is_heard(state):
    front, _ = scripted(*[state] * 40)
    learned = front.linear_stage.stats()["active_hops"] > 0
    assert learned == (state not in ("begun", "announced"))


class Watching:
    """Keeps what a learner is told."""

    def __init__(self):
        self.told = []

    def start(self, path, hop):
        pass

    def observe(self, hop):
        self.told.append(hop)


def test_a_learner_is_told_in_which_hops_nothing_of_the_robot_can_be_heard_and_where_its_place_is_known():
    learner = Watching()
    scripted("idle", "begun", "locked", learner=learner)
    assert [hop.idle for hop in learner.told] == [True, False, False]
    assert [hop.located for hop in learner.told] == [True, False, True]


@pytest.mark.parametrize(
    ("probability", "speaking", "nobody"),
    [(None, False, False), (0.1, False, True), (0.1, True, False), (0.9, True, False)],
)
def test_nobody_speaks_where_an_engine_that_judges_it_says_so(probability, speaking, nobody):
    front, frames = scripted("locked", "locked")
    front.hear(frames[-1], Output(frames[-1].error, probability), probability, speaking)
    assert front.linear_stage.residual.nobody_speaks == nobody


def test_a_constant_offset_is_off_within_some_hops_and_one_that_moves_is_followed():
    rng, centred = np.random.default_rng(0), Centred(256)
    noise = 0.01 * rng.standard_normal((400, 256)).astype(np.float32)
    offset = np.where(np.arange(400) < 200, 0.1, -0.1).astype(np.float32)[:, None]
    left = np.array([centred.step(hop).mean() for hop in noise + offset])
    assert np.abs(left[:200]).max() < 0.005  # from the first hop on
    assert np.abs(left[360:]).max() < 0.005 < np.abs(left[200])


def test_what_the_first_hop_says_of_the_offset_is_soon_outweighed():
    centred, hops = Centred(256), np.zeros((40, 256), np.float32)
    hops[0] = 0.1
    left = np.array([centred.step(hop).mean() for hop in hops])
    assert np.abs(left[10:]).max() < 0.02


@pytest.mark.parametrize("state", ["begun", "locked"])
def test_how_much_is_removed_is_told_of_hops_whose_reference_lies_where_it_is_heard(state):
    front, _ = scripted(*[state] * 250)
    assert (front.linear_stage.stats()["removed_db"] is not None) == (state == "locked")


def test_an_offset_of_the_microphone_leaves_the_robot_removed_and_is_removed_itself():
    """-30 dB of full scale, as cheap microphones have: 5 to 7 dB less were removed, and the robot's path learned in vain."""
    mic, ref = demonstration()
    plain, offset = (enhance(x, ref, None, engine="linear") for x in (mic, mic + np.float32(0.0316)))
    later = slice(3 * SAMPLE_RATE, 6 * SAMPLE_RATE)
    assert level_db(offset[later]) < level_db(plain[later]) + 0.5
    assert abs(float(offset[later].mean())) < 1e-4
    calibrated = enhance(mic + np.float32(0.0316), ref, DEMO / "profile.npz", engine="linear")
    assert abs(float(calibrated[later].mean())) < 1e-4


def test_rumble_does_not_spoil_what_is_learned_at_the_robot_s_frequencies():
    """As loud as the robot at 40 Hz; what a loudspeaker never plays was expected to be its loudest part."""
    mic, ref = demonstration()
    rumble = (np.std(mic) * np.sqrt(2) * np.sin(2 * np.pi * 40 * np.arange(mic.size) / SAMPLE_RATE)).astype(np.float32)
    voice = signal.butter(4, 300, "high", fs=SAMPLE_RATE, output="sos")
    later = slice(3 * SAMPLE_RATE, 6 * SAMPLE_RATE)
    without, beside = (
        level_db(signal.sosfiltfilt(voice, enhance(x, ref, None, engine="linear"))[later]) for x in (mic, mic + rumble)
    )
    assert beside < without + 9.0  # 7 dB; 11 dB without the bound


def demonstration() -> tuple[np.ndarray, np.ndarray]:
    """Microphone and reference of the bundled robot, alone from 1 s to 6 s."""
    mic, ref = demo("mic", "reference")
    return mic[: 8 * SAMPLE_RATE], ref[: 8 * SAMPLE_RATE]
