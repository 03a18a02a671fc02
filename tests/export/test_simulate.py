"""The training simulator: reproducible items whose parts are what they claim to be."""

from dataclasses import replace

import numpy as np
import pytest
import soundfile as sf

from edgefilter.dsp.stft import StftConfig
from edgefilter.echo.model import EchoModel
from edgefilter.errors import UsageError
from export.corpus import Corpus, read_corpus
from export.dataset import pack
from export.rooms import draw_room
from export.simulate import fan, script
from export.simulate.conversation import simulate
from export.simulate.effects import draw_effects, elsewhere
from export.simulate.linear_stage import Stage, WideSetting, from_bytes, front_end, listen
from export.simulate.loudspeaker import KINDS, active_rms, distorted
from export.simulate.material import RESPONSES, Material, read_noises, read_responses
from export.simulate.microphone import Suppression
from export.simulate.path import draw_colour
from export.simulate.recipe import DEVICES, PAPER, RECIPES, VOICES, WIDE
from tests.export.speech import RATE, babble, write_librispeech, write_table


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("speech")
    humans = read_corpus(write_librispeech(folder / "humans", ("11", "12", "13")))
    robots = read_corpus(write_table(folder / "robots", ("a", "b")))
    return Material(
        humans, robots, [draw_room(np.random.default_rng(kind == "lab"), kind) for kind in ("lab", "office")]
    )


def test_an_item_depends_on_seed_and_index_alone(parts):
    first, again = (simulate(RECIPES["edge"], 3, 5, parts) for _ in range(2))
    other = simulate(RECIPES["edge"], 3, 6, parts)
    assert np.array_equal(first.mic, again.mic) and first.about == again.about
    assert not np.array_equal(first.mic, other.mic)


def test_the_papers_recipe_has_the_papers_segments(parts):
    for index in range(6):
        item = simulate(PAPER, 1, index, parts)
        assert item.mic.size == item.clean.size == item.reference.size == 5 * RATE
        onset = int(np.argmax(np.abs(item.clean) > 1e-4 * np.abs(item.clean).max()))
        assert 0.5 * RATE <= onset < 1.6 * RATE  # 0.5 to 1.5 s, and the way through the room
        robot = item.mic - item.clean
        assert np.mean(robot**2) > 30 * np.mean(item.clean**2)


def test_the_human_is_inside_the_microphone(parts):
    item = simulate(replace(RECIPES["edge"], human=1.0, warm=1.0), 2, 0, parts)
    assert item.profile is not None and np.any(item.clean)
    silent = simulate(replace(RECIPES["edge"], human=0.0), 2, 0, parts)
    assert not np.any(silent.clean)


def test_an_item_says_who_speaks_and_in_which_recordings(parts):
    for index in range(3):
        about = simulate(replace(RECIPES["microphone"], human=1.0, plain=0.0), 2, index, parts).about
        known = {path.name for path in parts.humans.speakers[about["speaker"]]}
        assert about["recordings"] and set(about["recordings"]) <= known
    silent = simulate(replace(RECIPES["microphone"], human=0.0, plain=0.0), 2, 0, parts).about
    assert silent["speaker"] is None and silent["recordings"] == ()


def test_the_microphones_recipe_is_the_wide_one_without_the_filters_past():
    assert replace(RECIPES["microphone"], later=WIDE.later) == WIDE and RECIPES["microphone"].later == 0


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_each_kind_of_distortion_is_as_loud_as_asked_and_none_of_it_is_the_voice_itself(kind):
    rng = np.random.default_rng(4)
    voice = babble(rng, 4.0)
    added = distorted(rng, voice, (kind,), -25.0) - voice
    assert 20 * np.log10(active_rms(added) / active_rms(voice)) == pytest.approx(-25.0, abs=0.1)
    assert abs(np.dot(added, voice)) < 1e-2 * np.linalg.norm(added) * np.linalg.norm(voice)


def test_the_wide_recipe_has_every_kind():
    assert set(WIDE.kinds) == set(KINDS)


@pytest.mark.slow
def test_wide_items_hold_loud_humans_silent_robots_and_every_kind_of_start(parts):
    items = [simulate(replace(WIDE, plain=0.0, seconds=3.0), 8, index, parts) for index in range(60)]
    assert {item.about["profile"] for item in items} == {"none", "right", "level", "device", "path"}
    loud = [item.about["human_over_robot_db"] > -8 for item in items]
    assert 6 < sum(loud) < 35  # a third of 60, 4 standard deviations
    assert any(not item.reference.any() for item in items) and any(not item.clean.any() for item in items)
    assert max(np.abs(item.mic).max() for item in items) <= 1.0
    assert any(item.stage.missing_db is not None for item in items)
    assert len({item.stage.adaptation for item in items}) > 3


def test_a_robot_that_says_nothing_leaves_the_human_and_the_fan(parts):
    alone = replace(WIDE, plain=0.0, robot=0.0, human=1.0, near_share=0.0, fan_db=(40.0, 40.0), wideness=0.0)
    alone = replace(alone, seconds=4.0, silence_s=(0.0, 1.0), later=0.0)
    item = simulate(alone, 6, 0, parts)
    assert 20 * np.log10(active_rms(item.clean) / active_rms(item.fan)) == pytest.approx(40.0, abs=1.0)
    np.testing.assert_allclose(item.mic, item.clean + item.fan, atol=1e-6)
    stft = StftConfig()
    heard = listen(
        front_end(item.stage, item.profile, stft, np.random.default_rng(0)),
        item.mic,
        item.reference,
        item.clean,
        item.fan,
        stft,
    )
    np.testing.assert_allclose(heard.error, heard.clean + heard.fan, atol=1e-5)


@pytest.mark.slow
def test_an_item_of_a_filter_that_ran_before_holds_what_came_after(parts):
    stft, said = StftConfig(), {}
    for later in (0.0, 1.0):
        item = simulate(replace(RECIPES["edge"], later=later, seconds=2.0, human=0.0), 3, 2, parts)
        assert (item.before, item.mic.size) == (later * 2 * RATE, (1 + later) * 2 * RATE)
        said[later] = pack(item, stft, np.random.default_rng(0))
        assert said[later]["mic"].shape == (2 * RATE,) and said[later]["noise"].shape[0] == 2 * RATE // 256


@pytest.mark.slow
def test_a_front_that_learns_leaves_less_of_a_loudspeaker_that_distorts(parts):
    recipe = replace(RECIPES["edge"], moving=0.0, warm=0.0, human=0.0, seconds=9.0, distortion_db=(-14.0, -14.0))
    item, stft, left = simulate(recipe, 3, 1, parts), StftConfig(), {}
    for learns in (False, True):
        front = front_end(Stage(), None, stft, np.random.default_rng(0), learns)
        heard = listen(front, item.mic, item.reference, item.clean, item.fan, stft, before=6 * RATE)
        left[learns] = 10 * np.log10(np.mean(heard.error**2))
    print(left)
    assert left[True] < left[False] - 0.5


def test_a_weakened_canceller_leaves_as_much_more_as_asked_and_a_lost_one_everything(parts):
    item = simulate(replace(RECIPES["edge"], moving=0.0, warm=1.0, human=0.0, seconds=6.0), 3, 1, parts)
    stft, left = StftConfig(), {}
    for missing_db in (None, -6.0, np.inf):
        front = front_end(Stage(missing_db=missing_db), item.profile, stft, np.random.default_rng(1))
        heard = listen(front, item.mic, item.reference, item.clean, item.fan, stft)
        left[missing_db] = 10 * np.log10(np.mean(heard.error**2) / np.mean(heard.mic**2))
    assert left[None] < -12
    assert left[-6.0] == pytest.approx(-6.0, abs=1.5)  # the filter's energy is exact, its gain for a voice is not
    assert left[np.inf] == pytest.approx(0.0, abs=1e-6)


def test_frames_cut_from_the_stored_sound_are_the_engines_own(parts):
    item = simulate(replace(RECIPES["edge"], warm=1.0, seconds=3.0), 2, 3, parts)
    stft = StftConfig()
    front = front_end(item.stage, item.profile, stft, np.random.default_rng(0))
    frames = [front.step(item.mic[at : at + 256], item.reference[at : at + 256])[0] for at in range(0, 47872, 256)]
    front = front_end(item.stage, item.profile, stft, np.random.default_rng(0))
    heard = listen(front, item.mic, item.reference, item.clean, item.fan, stft)
    for t in (50, 120, 180):
        found = np.fft.rfft(heard.error[(t - 1) * 256 : (t + 1) * 256] * stft.analysis_window)
        np.testing.assert_allclose(found, frames[t].error, atol=1e-5 * np.abs(frames[t].error).max() + 1e-7)
        told = from_bytes(heard.residual[t])
        assert np.abs(10 * np.log10(told / np.maximum(frames[t].residual_psd, 1e-9))).max() < 0.26


def test_settings_of_the_linear_stage_are_drawn_in_their_shares():
    rng = np.random.default_rng(0)
    stages = [WideSetting().draw(rng, warm=True) for _ in range(400)]
    assert 0.4 < np.mean([stage.taps is None for stage in stages]) < 0.6  # own: 0.5, 4 standard deviations
    assert 0.01 < np.mean([stage.missing_db == np.inf for stage in stages]) < 0.1
    weakened = [s.missing_db for s in stages if s.missing_db is not None and np.isfinite(s.missing_db)]
    assert min(weakened) > -25 and max(weakened) < -3 and 60 < len(weakened) < 140
    assert all(1024 <= stage.taps <= 8192 for stage in stages if stage.taps)


def test_recorded_noises_and_measured_responses_are_used(parts, tmp_path):
    rng = np.random.default_rng(1)
    for kind in ("room", "loudspeaker", "microphone"):
        (tmp_path / "rir" / kind).mkdir(parents=True)
        decay = rng.standard_normal(800) * np.exp(-np.arange(800) / 100)
        sf.write(tmp_path / "rir" / kind / "a.flac", np.append(0.9, 0.2 * decay / np.abs(decay).max()), RATE)
    (tmp_path / "noise").mkdir()
    sf.write(tmp_path / "noise" / "hum.wav", 0.3 * np.sin(np.arange(RATE) * 2 * np.pi * 100 / RATE), RATE)
    material = replace(parts, noises=read_noises(tmp_path / "noise"), responses=read_responses(tmp_path / "rir"))
    assert {kind: len(each) for kind, each in material.responses.items()} == dict.fromkeys(RESPONSES, 1)
    assert all(response[0] == 1.0 for (response,) in material.responses.values())
    recipe = replace(WIDE, plain=0.0, seconds=2.0)
    with_them, without = ([simulate(recipe, 5, index, each).mic for index in range(12)] for each in (material, parts))
    assert sum(not np.array_equal(a, b) for a, b in zip(with_them, without)) > 3
    with pytest.raises(UsageError, match="holds no impulse response"):
        read_responses(tmp_path / "noise" / "nothing")


def test_a_voice_that_is_played_faster_is_higher_and_shorter(tmp_path):
    tone = np.sin(2 * np.pi * 400 * np.arange(16000) / 16000).astype(np.float32)
    sf.write(tmp_path / "one-1-0.flac", tone, 16000)
    corpus = read_corpus(tmp_path)
    for rate in (80, 100, 125):
        speech = corpus.draw(np.random.default_rng(0), "one", 3.0, rate=rate)
        assert np.argmax(np.abs(np.fft.rfft(speech[4000:8000]))) * 4 == pytest.approx(4 * rate, abs=4)
        end = 16000 * 100 // rate
        assert speech[end - 100 : end - 60].any() and not speech[end + 1 : end + 1600].any()


def test_half_of_the_speakers_of_many_voices_are_given_another_voice():
    rng = np.random.default_rng(0)
    rates = np.array([script.rate(rng, VOICES) for _ in range(400)])
    other = rates[rates != 100]
    assert 0.4 < other.size / rates.size < 0.6 and (other.min(), other.max()) == script.RATES
    assert {script.rate(rng, WIDE) for _ in range(20)} == {100}


def test_a_device_that_suppresses_noise_has_one_gain_for_all_that_is_heard_and_no_linear_filter_follows_it():
    rng = np.random.default_rng(0)
    loud, soft = rng.standard_normal((2, 2 * RATE)).astype(np.float32) * np.float32([[0.1], [0.01]])
    quiet = np.arange(loud.size) % 8000 >= 4000
    loud[quiet] = 0.0
    changed = Suppression(6.0, -20.0, 6.0, 20.0, 8, seed=1)
    both, of_loud, of_soft = changed.applied(loud + soft, loud, soft)
    assert both.size == loud.size and np.allclose(both, of_loud + of_soft, atol=1e-6)
    assert np.mean(of_soft[quiet] ** 2) < 0.4 * np.mean(soft[quiet] ** 2)  # with what the jitter adds
    spectra, after = (np.fft.rfft(x.reshape(-1, 800)) for x in (loud, of_loud))
    left = after - spectra * np.sum(after * spectra.conj(), 0) / np.sum(np.abs(spectra) ** 2, 0)
    assert np.sum(np.abs(left) ** 2) > 0.1 * np.sum(np.abs(after) ** 2)  # the best filter leaves more than -10 dB


def test_where_the_reference_was_found_only_about_it_is_told_early_or_late(parts):
    recipe = replace(DEVICES, plain=0.0, seconds=3.0, later=0.0, robot=1.0)
    item = simulate(replace(recipe, setting=WideSetting(lost=1.0, displaced_s=0.06)), 7, 2, parts)
    assert 0 < abs(item.stage.displaced) <= 960
    there, displaced = (
        pack(replace(item, stage=replace(item.stage, displaced=at)), StftConfig(), np.random.default_rng(0))
        for at in (0, item.stage.displaced)
    )
    assert np.array_equal(np.roll(there["reference"], item.stage.displaced), displaced["reference"])
    assert np.array_equal(there["mic"], displaced["mic"])


def test_the_field_and_its_gestures_alone_have_soft_humans_and_knocks():
    assert {name for name, recipe in RECIPES.items() if recipe.soft or recipe.knocks} == {"field", "gestures"}
    assert RECIPES["gestures"] == replace(RECIPES["field"], motors=0.6)


def test_a_soft_human_rises_from_nothing_within_300_ms_and_is_the_same_behind(parts):
    recipe = replace(RECIPES["edge"], human=1.0, silence_s=(0.5, 0.5), soft=1.0)
    risen = script.human(np.random.default_rng(2), recipe, parts.humans, np.ones(1, np.float32), 2 * RATE).clean
    recipe = replace(recipe, soft=1e-9)  # drawn, and not
    at_once = script.human(np.random.default_rng(2), recipe, parts.humans, np.ones(1, np.float32), 2 * RATE).clean
    ratio = (risen / np.where(at_once, at_once, np.nan))[RATE // 2 :]
    assert np.nanmax(ratio[:80]) < 0.11 and np.nanmin(ratio[round(0.3 * RATE) :]) == pytest.approx(1.0, abs=1e-3)


def test_knocks_are_short_as_loud_as_the_human_and_begin_while_nobody_speaks(parts):
    clean = np.zeros(4 * RATE, np.float32)
    clean[2 * RATE :] = 0.1 * np.random.default_rng(1).standard_normal(2 * RATE)
    rms = active_rms(clean)
    material = replace(parts, noises=(babble(np.random.default_rng(2), 3.0),))
    for seed in range(20):
        knocks = fan.knocks(np.random.default_rng(seed), material, clean, rms)
        assert knocks.any() and not knocks[round(2.4 * RATE) :].any()  # 0.4 s: the longest
        assert np.count_nonzero(knocks) <= fan.KNOCKS * 0.4 * RATE
        assert -10.5 < 20 * np.log10(active_rms(knocks) / rms) < 9  # several may fall on each other
    assert fan.knocks(np.random.default_rng(0), parts, np.zeros(RATE, np.float32), rms).any()  # nobody, no recordings


def test_gears_turn_only_from_where_the_robot_talks_and_whine_in_harmonics_of_a_pitch_that_moves():
    talking = np.arange(6 * RATE) < 3 * RATE
    share, peaks = [], []
    for seed in range(12):
        sound = fan.gears(np.random.default_rng(seed), talking)
        assert np.isfinite(sound).all() and sound.any() and not sound[5 * RATE :].any()  # 1.6 s: the longest turn
        power = np.square(np.abs(np.fft.rfft(sound[: 3 * RATE].reshape(-1, RATE // 10) * np.hanning(RATE // 10))))
        loud = power.sum(1) > 0.1 * power.sum(1).max()
        share.append(np.mean(np.sort(power[loud], axis=1)[:, -24:].sum(1) / power[loud].sum(1)))
        peaks.append(np.unique(power[loud].argmax(1)).size)
    assert max(share) > 0.8  # of the power lies in 24 of 801 bins: tones
    assert np.median(peaks) > 3


def test_who_says_three_words_is_drawn_seldom():
    corpus = Corpus({"few": (), "many": ()}, {"few": 2.0, "many": 60.0})
    rng = np.random.default_rng(0)
    assert 0 < sum(corpus.draw_speaker(rng) == "few" for _ in range(2000)) < 60  # 1 % of 2000


def test_effects_of_a_profile_change_the_robot(parts):
    plain = replace(RECIPES["edge"], moving=0.0, effects_share=1.0)
    turned_down = replace(plain, effects=(("bandlimit", {"cutoff_hz": 1500.0, "order": 4.0}),))
    items = [simulate(recipe, 4, 1, parts) for recipe in (plain, turned_down)]
    high = [np.sum(np.abs(np.fft.rfft(item.mic - item.clean))[-item.mic.size // 8 :] ** 2) for item in items]
    assert high[1] < 0.5 * high[0]
    assert items[1].about["effects"] == ["bandlimit"]


def test_packets_are_lost_elsewhere_as_often_as_where_they_were_found_and_other_events_are_not():
    times = np.arange(5) * 0.8  # of 20 ms: 100 ms in 3.22 s
    lost = {"times_s": times, "length_ms": 20.0, "fill": 0.5, "fade_ms": 1.0, "lost": 5.0}
    band = {"cutoff_hz": 3000.0, "order": 4.0}
    found = (("packet_loss", lost), ("path_change", {"time_s": 1.0}), ("bandlimit", band))
    drawn = [elsewhere(np.random.default_rng(seed), found, 12.0) for seed in range(200)]
    assert all([name for name, _ in each] == ["packet_loss", "bandlimit"] for each in drawn)
    assert all(each[1][1] == band and each[0][1]["fill"] == 0.5 for each in drawn)
    first, second = (each[0][1] for each in drawn[:2])
    assert not np.array_equal(first["times_s"], second["times_s"]) and first["lost"] == first["times_s"].size
    shares = [each[0][1]["lost"] * 0.02 / 12.0 for each in drawn]
    # the mean of 2^u, u evenly in -1 to 1, is 1.5 / (2 ln 2) = 1.08
    assert np.mean(shares) == pytest.approx(1.08 * 0.1 / 3.22, rel=0.15)


def test_drawn_effects_can_be_predicted_and_packets_are_lost_in_their_shares():
    shares = []
    for seed in range(40):
        drawn = draw_effects(np.random.default_rng(seed), 1.0, 1.0, 12.0)
        echo = EchoModel(np.eye(1, 32, dtype=np.float32)[0], drawn).predict(np.ones(RATE, np.float32))
        assert np.isfinite(echo).all(), drawn
        shares += [v["lost"] * v["length_ms"] / 12000 for name, v in drawn if name == "packet_loss"]
    assert len(shares) >= 5
    assert max(shares) < 0.2
    assert np.median(shares) > 0.003


def test_rooms_decay_as_long_as_asked():
    room = draw_room(np.random.default_rng(3), "office")
    energy = np.cumsum(room.humans[0][::-1].astype(float) ** 2)[::-1]
    decay = 10 * np.log10(energy / energy[0])
    fall = (np.argmax(decay < -35) - np.argmax(decay < -5)) / RATE * 2
    assert 0.5 * room.rt60_s < fall < 2.0 * room.rt60_s  # Sabine's formula is that coarse in small rooms


def test_a_folder_without_speech_is_named(tmp_path):
    with pytest.raises(UsageError, match="holds no speech"):
        read_corpus(tmp_path)


def test_the_robots_colour_is_always_stable():
    for seed in range(300):
        colour = draw_colour(np.random.default_rng(seed))
        assert np.isfinite(colour).all() and np.abs(colour[-100:]).max() < 0.1 * np.abs(colour).max()
