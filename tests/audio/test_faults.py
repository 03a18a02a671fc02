"""What befalls sound devices while a run goes on, on virtual ones: it goes on, says so, and counts what is missing."""

import json
import sys
from functools import partial

import numpy as np
import pytest
import soundfile

from edgefilter.audio.channels import Channels
from edgefilter.audio.files import FileSink, FileSource
from edgefilter.audio.live import LiveSink, LiveSource
from edgefilter.audio.pairing import TOLERANCE
from edgefilter.audio.protocols import Troubles
from edgefilter.audio.sample_clock import Lateness, SampleClock
from edgefilter.audio.steady import SteadySink
from edgefilter.cli import main
from edgefilter.commands.run import check_output, limited
from edgefilter.errors import DeviceError, UsageError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import filter_blocks
from tests.audio.virtual_portaudio import CALLBACK_S, VirtualDevice
from tests.filter.array_scene import calibration

FOREVER = float("inf")
STEP = round(CALLBACK_S * 16000)


@pytest.fixture
def both(plug):
    mic, ref = VirtualDevice("mic", "input"), VirtualDevice("ref", "input")
    return plug(mic, ref), mic, ref


def run(source, path, sink=None, seconds=None):
    """A whole run into a file, or a device, as `edgefilter run` has it; report, events by kind, and the file's samples."""
    ego, told = EgoFilter(engine="bypass"), {}
    with source, sink or FileSink(path) as out:
        report = filter_blocks(
            limited(source, seconds and seconds * 16000),
            ego,
            out,
            tell=lambda event: told.setdefault(event.kind, []).append(event),
            troubles=Troubles(source, out),
        )
    heard = None if sink else np.concatenate([block.mic for block in FileSource(path)])
    return report, told, heard


def test_a_microphone_that_is_unplugged_comes_back_and_the_file_keeps_its_time(both, tmp_path):
    system, mic, _ = both
    system.at(4.0, lambda: setattr(mic, "plugged", False))
    system.at(11.0, lambda: setattr(mic, "plugged", True))
    source = LiveSource("mic", "ref", patience_s=FOREVER)
    began = system.now
    report, told, heard = run(source, tmp_path / "x.wav", seconds=20)
    assert report.failure is None and heard.size == report.samples_in == report.samples_out == 20 * 16000
    assert system.now - began == pytest.approx(20, abs=0.6)  # settling, and what a callback and the pairing hold back
    stats = source.stats()
    silent = int(np.count_nonzero(heard == 0.0))
    assert stats["microphone_away"] == pytest.approx(silent, abs=STEP) and 7 * 16000 <= silent <= 8.2 * 16000
    assert report.lost == stats["lost"] == stats["microphone_away"]
    assert [len(told[kind]) for kind in ("device_gone", "device_back")] == [1, 1]
    assert told["device_gone"][0].detail == "microphone: silence stands in until it is back"
    assert (stats["microphone_gone"], stats["microphone_back"]) == (1, 1)
    edges = np.flatnonzero(np.diff((heard == 0.0).astype(int))) / 16000
    assert edges == pytest.approx([4.0 - 0.2, edges[1]], abs=0.1) and 10.8 <= edges[1] <= 12.0


def test_a_reference_that_stops_is_silence_until_it_runs_again_and_fits_then(both, tmp_path):
    system, _, ref = both
    system.at(4.0, lambda: setattr(ref, "plugged", False))
    system.at(9.0, lambda: setattr(ref, "plugged", True))
    with LiveSource("mic", "ref", patience_s=FOREVER) as source:
        blocks = list(limited(source, 14 * 16000))
    heard = np.concatenate([block.ref for block in blocks])
    assert heard.size == 14 * 16000 and np.all(np.concatenate([block.mic for block in blocks]) == 0.25)
    silent, stats = int(np.count_nonzero(heard == 0.0)), source.stats()
    assert stats["lost"] == sum(block.lost for block in blocks) == pytest.approx(silent, abs=STEP)
    assert 5 * 16000 <= silent <= 6.3 * 16000 and not np.any(heard[-2 * 16000 :] == 0.0)
    assert (stats["reference_gone"], stats["reference_back"]) == (1, 1)


def test_a_reference_that_stutters_stays_in_step_and_every_gap_is_counted(both):
    system, _, ref = both
    for second in range(1, 21, 4):
        system.at(second, lambda: setattr(ref, "swallows", 0.1))
    with LiveSource("mic", "ref") as source:
        blocks = list(limited(source, 26 * 16000))
    stats = source.stats()
    silent = sum(int(np.count_nonzero(block.ref == 0.0)) for block in blocks)
    assert stats["reference_inserted"] + stats["reference_filled"] == silent
    assert silent == pytest.approx(0.5 * 16000, abs=TOLERANCE)  # so much was swallowed
    assert stats["reference_gone"] == 0 and sum(block.mic.size for block in blocks) == 26 * 16000


@pytest.mark.parametrize("swallowed", [0.15, 0.5])
def test_reference_that_a_driver_loses_is_lost_once_in_counters_and_events(both, tmp_path, swallowed):
    system, _, ref = both
    system.at(6.0, lambda: setattr(ref, "swallows", swallowed))
    source, told = LiveSource("mic", "ref"), []
    with source, FileSink(tmp_path / "x.wav") as out:
        troubles, heard = Troubles(source, out), []
        for block in limited(source, 14 * 16000):
            heard.append(block.ref)
            told += [event.detail for event in troubles(block.start + block.mic.size, False)]
    silent = int(np.count_nonzero(np.concatenate(heard) == 0.0))
    assert source.stats()["lost"] == silent >= swallowed * 16000
    assert sum(int(part.split()[0]) for detail in told for part in detail.split(", ")) == silent


def test_a_microphone_without_a_reference_is_never_held_back(both):
    system, mic, _ = both
    system.at(2.0, lambda: setattr(mic, "swallows", 0.199))
    with LiveSource("mic") as source:
        times = [system.now for _ in limited(source, 4 * 16000)]
    assert max(np.diff(times)) == pytest.approx(0.2 + CALLBACK_S, abs=CALLBACK_S / 2)


def test_sound_that_a_driver_loses_without_a_word_is_counted(both):
    system, mic, ref = both
    system.at(6.0, lambda: [setattr(each, "swallows", 0.5) for each in (mic, ref)])
    with LiveSource("mic", "ref") as source:
        list(limited(source, 14 * 16000))
    stats = source.stats()
    for name in ("microphone_lost", "reference_lost"):
        assert stats[name] == pytest.approx(0.5 * 16000, abs=2 * STEP)
    assert stats["lost"] == pytest.approx(0.5 * 16000, abs=2 * STEP), "half a second is missing, not one a device"


def test_after_a_suspend_the_run_goes_on_and_says_how_long_nothing_was_heard(both, tmp_path):
    system, _, _ = both
    system.at(6.0, lambda: system.pass_by(3600.0))
    source = LiveSource("mic", "ref", patience_s=FOREVER)
    report, told, heard = run(source, tmp_path / "x.wav", seconds=14)
    assert report.failure is None and heard.size == 14 * 16000
    stats = source.stats()
    assert stats["microphone_lost"] == pytest.approx(3600 * 16000, rel=1e-3) and stats["microphone_gone"] == 0
    assert any("microphone lost" in event.detail for event in told["lost"])
    assert report.lost == stats["lost"] == pytest.approx(3600 * 16000, rel=1e-3)  # of both devices: said were two hours


def test_a_filter_that_is_too_slow_loses_what_the_rings_cannot_hold_and_counts_it(both):
    system, _, _ = both
    slow = {10: 3.5}
    with LiveSource("mic", "ref") as source:
        blocks = []
        for block in limited(source, 14 * 16000):
            blocks.append(block)
            for _ in range(round(slow.pop(len(blocks), 0.0) / CALLBACK_S)):
                system.sleep(CALLBACK_S)  # the filter computes; the devices go on
    stats = source.stats()
    assert stats["microphone_lost"] == pytest.approx(1.5 * 16000, abs=2 * STEP)  # 3.5 s less the 2 s that a ring holds
    mic = np.concatenate([block.mic for block in blocks])
    assert np.count_nonzero(mic == 0.0) == stats["microphone_lost"]  # in their place is silence
    assert sum(block.lost for block in blocks) == stats["lost"]


@pytest.mark.parametrize("fast", ["mic", "ref"])
@pytest.mark.parametrize("ppm", [300.0, -300.0, 2000.0])
def test_devices_whose_clocks_differ_by_300_ppm_stay_together(plug, fast, ppm):
    """At 0.2 %, which no sound card has, the difference counts as lost sound as well, and is followed in the same way."""
    mic, ref = (VirtualDevice(name, "input", ppm=ppm * (name == fast)) for name in ("mic", "ref"))
    plug(mic, ref)
    with LiveSource("mic", "ref") as source:
        size = sum(block.mic.size for block in limited(source, 100 * 16000))
    stats = source.stats()
    ahead = (ppm > 0) == (fast == "ref")
    moved = stats["reference_dropped" if ahead else "reference_inserted"]
    assert size == 100 * 16000 and stats["lost"] == moved == stats["reference_dropped"] + stats["reference_inserted"]
    assert moved > 0 and abs(100 * 16000 * 1e-6 * abs(ppm) - moved) <= TOLERANCE + STEP


SOUND = np.arange(1, 20 * 16000, dtype=np.float32) / 2**19
"""20 s, of which each sample tells its place."""


def in_step(plug, seconds, **losses):
    """Both devices hear the same for so long: what is lost of one at (second, how, s), and the reference's shift at each sample."""
    devices = [VirtualDevice(name, "input", sound=SOUND) for name in ("mic", "ref")]
    system = plug(*devices)
    for device in devices:
        for second, how, lost_s in losses.get(device.name, ()):
            system.at(second, partial(setattr, device, how, lost_s))
    with LiveSource("mic", "ref") as source:
        blocks = list(limited(source, seconds * 16000))
    mic, ref = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("mic", "ref"))
    shift = np.where(ref == 0.0, 0, np.rint((mic - ref) * 2**19).astype(int))
    return shift, int(np.count_nonzero(ref == 0.0)), source.stats()


@pytest.mark.parametrize("device", ["mic", "ref"])
@pytest.mark.parametrize("lost_s, within_s", [(0.02, 0.5), (0.199, 0.1)])
def test_what_a_driver_loses_each_second_is_followed_within_half_a_second_and_sooner_where_it_is_more(
    plug, device, lost_s, within_s
):
    """Until the counters had differed by more than a callback for two to four seconds, nothing was paired rightly."""
    shift, silent, stats = in_step(plug, 12, **{device: [(second, "swallows", lost_s) for second in range(2, 11)]})
    off = shift != 0
    edges = np.flatnonzero(np.diff(off.astype(int), prepend=0, append=0)).reshape(-1, 2)
    assert np.all(np.diff(edges) <= within_s * 16000) and not off[-8000:].any()
    lost = 9 * lost_s * 16000
    assert (
        stats["lost"]
        == stats["reference_dropped" if device == "mic" else "reference_inserted"] + stats["reference_filled"]
    )
    assert stats["lost"] == pytest.approx(lost, abs=9 * 160) and silent == (stats["lost"] if device == "ref" else 0)


@pytest.mark.parametrize("late_s", [0.2, 1.0])
@pytest.mark.parametrize("devices", [["mic"], ["ref"], ["mic", "ref"]], ids=str)
def test_sound_that_a_device_holds_back_and_delivers_at_once_is_paired_as_if_it_had_come_in_time(plug, devices, late_s):
    shift, silent, stats = in_step(plug, 8, **{device: [(3, "holds", late_s)] for device in devices})
    assert not shift.any() and stats["lost"] == silent == (12000 if devices == ["ref"] and late_s > 0.25 else 0)


def test_a_device_of_another_rate_and_number_of_channels_is_converted_and_said(plug, tmp_path):
    plug(
        VirtualDevice("mic", "input", 44100.0, takes=(44100, 2)),
        VirtualDevice("ref", "input", 48000.0, takes=(48000, 1)),
        VirtualDevice("speaker", "output", 48000.0, takes=(48000, 2)),
    )
    source, sink = LiveSource("mic", "ref"), LiveSink("speaker", latency=512, wait=False)
    report, _, _ = run(source, None, sink, seconds=4)
    assert report.failure is None and report.samples_out == 4 * 16000 and not source.stats()["lost"]
    said = " ".join((*source.notes, *sink.notes))
    for words in ("opened at 44100 Hz", "2 channels averaged", "opened at 48000 Hz", "2 channels get the same"):
        assert words in said


def test_a_device_that_can_be_opened_in_no_way_is_one_line(plug):
    plug(VirtualDevice("mic", "input", 44100.0, takes=(192000, 7)))
    with pytest.raises(DeviceError, match="'mic' cannot be opened at 16000 Hz or 44100 Hz: Invalid sample rate"):
        LiveSource("mic")


def test_an_output_device_that_is_unplugged_comes_back_and_what_was_not_played_is_counted(plug):
    mic, speaker = VirtualDevice("mic", "input"), VirtualDevice("speaker", "output")
    system = plug(mic, speaker)
    system.at(4.0, lambda: setattr(speaker, "plugged", False))
    system.at(12.0, lambda: setattr(speaker, "plugged", True))
    source = LiveSource("mic", patience_s=FOREVER)
    sink = SteadySink(lambda: LiveSink("speaker", latency=512, wait=False))
    report, told, _ = run(source, None, sink, seconds=20)
    stats = sink.stats()
    assert report.failure is None and (stats["output_gone"], stats["output_back"]) == (1, 1)
    assert [len(told[kind]) for kind in ("device_gone", "device_back")] == [1, 1]
    played = sum(int(np.count_nonzero(part)) for part in speaker.played)
    # every sample was played, dropped for a full queue, or found no device; what the device held when it went is unknown
    assert played + stats["dropped"] + stats["output_away"] == pytest.approx(20 * 16000, abs=0.5 * 16000)
    assert played == pytest.approx(12 * 16000, abs=1.5 * 16000)


def test_an_output_device_is_named_by_a_part_with_a_dot_and_what_is_no_device_is_no_file(plug):
    plug(VirtualDevice("mic", "input"), VirtualDevice("alsa_output.usb-4", "output"))
    check_output("output.usb")
    with pytest.raises(UsageError, match="out.xyz is no file, which ends in .wav or .flac, and no device: output dev"):
        check_output("out.xyz")


def test_a_device_that_was_never_there_is_an_error_and_not_waited_for(plug, tmp_path):
    plug(VirtualDevice("mic", "input"), VirtualDevice("speaker", "output", plugged=False))
    with pytest.raises(DeviceError, match="output device 'speaker' cannot be opened"):
        SteadySink(lambda: LiveSink("speaker"))


def test_patience_that_is_over_ends_the_run_with_what_was_heard(both, tmp_path):
    system, mic, _ = both
    system.at(4.0, lambda: setattr(mic, "plugged", False))
    report, _, heard = run(LiveSource("mic", "ref", patience_s=5.0), tmp_path / "x.wav")
    assert isinstance(report.failure, DeviceError) and "'mic' stopped" in str(report.failure)
    assert heard.size == report.samples_in and np.count_nonzero(heard) == pytest.approx(3.8 * 16000, abs=0.1 * 16000)


def test_a_clock_that_would_count_everything_as_lost_is_refused():
    assert Lateness(look_s=0.0).look_s == 0.0
    for name in ("stall_s", "held_s"):
        with pytest.raises(UsageError, match=f"{name} is 0.0, expected more than 0"):
            Lateness(**{name: 0.0})


@pytest.mark.parametrize("ppm", [300, -300])
def test_late_sound_is_not_lost_and_drift_is_no_loss(ppm):
    watch, delivered = SampleClock(), 0.0
    for tick in range(19_900):
        now = tick * 0.01
        if not (tick // 100) % 7 == 3:  # a second's pause now and then, after which all of it comes
            delivered = now * (1 - 1e-6 * ppm)
            watch.note(delivered, now)
    assert watch.missed == 0.0 and watch.drifted == pytest.approx(199 * 1e-6 * ppm, abs=1e-3)
    for tick in range(19_900, 20_000):
        watch.note(delivered + tick * 0.01 - now, tick * 0.01 + 0.06)
    assert watch.missed == pytest.approx(0.06, abs=1e-3)
    for tick in range(20_000, 20_100):
        watch.note(delivered + tick * 0.01 - now, tick * 0.01)
    assert watch.missed == pytest.approx(0.0, abs=1e-3)  # it came after all


def test_the_channels_of_a_device_that_are_named_are_taken_and_one_of_them_is_the_reference(plug):
    plug(VirtualDevice("array", "input", rate=48000.0, takes=(48000, 6), channels=6))
    source = LiveSource("array", channels=Channels([1, 2, 4], 5))
    with source:
        blocks = list(limited(source, 16000))
    mic, ref = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("mic", "ref"))
    assert source.microphones == 3 and mic.shape == (16000, 3) and ref.shape == (16000,)
    assert mic[8000:] == pytest.approx(np.tile([0.2, 0.3, 0.5], (8000, 1)), abs=1e-3)
    assert ref[8000:] == pytest.approx(0.6, abs=1e-3) and source.stats()["lost"] == 0
    assert any("channels 1, 2, 4, 5 of 6" in note for note in source.notes)


def test_an_array_that_is_unplugged_comes_back_with_all_its_microphones(plug):
    array, ref = VirtualDevice("array", "input", channels=4), VirtualDevice("ref", "input")
    system = plug(array, ref)
    system.at(3.0, lambda: setattr(array, "plugged", False))
    system.at(8.0, lambda: setattr(array, "plugged", True))
    source = LiveSource("array", "ref", patience_s=FOREVER, channels=Channels([0, 3]))
    with source:
        mic = np.concatenate([block.mic for block in limited(source, 15 * 16000)])
    assert mic.shape == (15 * 16000, 2) and mic[-1] == pytest.approx([0.1, 0.4])
    silent = np.count_nonzero(mic[:, 0] == 0.0)
    assert silent > 4 * 16000 and source.stats()["microphone_away"] == pytest.approx(silent, abs=STEP)


def test_a_channel_that_a_device_lacks_is_one_line(plug):
    plug(VirtualDevice("array", "input", channels=4))
    with pytest.raises(UsageError, match="input device 'array' has 4 channels, 0 to 3, found channel 4 asked for"):
        LiveSource("array", channels=Channels([1, 4]))


def test_all_channels_of_a_device_are_opened_where_that_is_asked(plug):
    plug(VirtualDevice("array", "input", channels=4), VirtualDevice("mixer", "input", channels=32))
    source = LiveSource("array", channels=Channels())
    with source:
        heard = np.concatenate([block.mic for block in limited(source, 16000)])
    assert source.microphones == 4 and any("channels 0, 1, 2, 3 of 4" in note for note in source.notes)
    np.testing.assert_allclose(heard[-1], [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    with pytest.raises(UsageError, match="'mixer' has 32 channels, expected at most 8 microphones: name them"):
        LiveSource("mixer", channels=Channels())


def test_a_run_whose_learner_cannot_be_started_says_so_and_filters_all(both, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    monkeypatch.setattr("edgefilter.commands.run.allowed_cores", lambda: {0, 1})  # on one core nothing is learned
    words = ["run", "--input", "mic", "--reference", "ref", "--engine", "linear", "--seconds", "1", "--quiet"]
    assert main([*words, "--output", str(tmp_path / "out.wav")]) == 0
    assert "the learner's process ended before the run" in capsys.readouterr().err
    assert soundfile.info(tmp_path / "out.wav").frames == 16000


@pytest.mark.parametrize("microphones", [3, 1])
def test_a_run_opens_an_array_where_the_profile_is_of_one_and_says_what_it_does(plug, tmp_path, capsys, microphones):
    plug(VirtualDevice("array", "input", channels=3), VirtualDevice("line", "input"))
    calibration(microphones).save(tmp_path / "robot.npz")

    def run(*more):
        words = ["run", "--input", "array", "--reference", "line", "--profile", tmp_path / "robot.npz", "--quiet"]
        words += ["--engine", "linear", "--no-learn", "--seconds", "1", "--output", tmp_path / "out.wav", *more]
        return main([str(word) for word in words]), capsys.readouterr().err

    code, said = run("--json", tmp_path / "run.json")
    array = json.loads((tmp_path / "run.json").read_text())["array"]
    if microphones == 3:
        assert array["microphones"] == 3 and "all 3 channels are microphones, since the profile is of an array" in said
        code, said = run("--mic-channels", "0,1")
        assert code == 1 and "holds 3 microphones, found 2" in said
    else:
        assert array is None and "the microphone has 3 channels and is one: name those of an array" in said
        code, said = run("--mic-channels", "all")
        assert code == 1 and "holds 1 microphones, found 3" in said
