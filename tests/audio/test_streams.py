"""The parts of live audio that need no device: pipes, finding devices, pairing two clocks, missing PortAudio."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edgefilter.audio.device import match, monitor
from edgefilter.audio.pairing import MAX_WAIT, Inlet, Outlet, Pairing
from edgefilter.audio.pulse import Device
from edgefilter.audio.raw import PcmSink, PcmSource
from edgefilter.errors import AudioFileError, DeviceError, SignalError, UsageError

DEVICES = [
    Device(0, "USB Audio: mic", 1, 0, 48000.0), Device(1, "Speakers", 0, 2, 48000.0), Device(2, "USB Audio: line", 2, 0, 48000.0),
    Device(3, "Monitor of Speakers", 2, 0, 48000.0), Device(4, "robot", 0, 1, 16000.0), Device(5, "robot.monitor", 1, 0, 16000.0),
    Device(6, "default", 2, 2, 48000.0),
]  # fmt: skip


def test_stdin_is_microphone_and_reference_and_stray_bytes_are_said():
    pcm = np.array([[1, -2], [32767, -32768], [5, 6]], "<i2")
    source = PcmSource(io.BytesIO(pcm.tobytes() + b"\x01\x02\x03"))
    blocks = list(source)
    np.testing.assert_array_equal(np.concatenate([b.mic for b in blocks]) * 32768, pcm[:, 0])
    np.testing.assert_array_equal(np.concatenate([b.ref for b in blocks]) * 32768, pcm[:, 1])
    assert source.total == 3 and "last 3 bytes were ignored" in source.notes[0]


def test_samples_cut_by_the_pipe_are_put_together():
    data = np.arange(4000, dtype="<i2").tobytes()
    read, write = os.pipe()
    os.write(write, data[:101])
    source = iter(PcmSource(os.fdopen(read, "rb")))
    first = next(source)
    assert first.mic.size == 25
    os.write(write, data[101:])
    os.close(write)
    rest = list(source)
    np.testing.assert_array_equal(np.concatenate([first.mic, *(b.mic for b in rest)]) * 32768, np.arange(0, 4000, 2))
    assert rest[0].start == 25


def test_stdin_without_sound_is_an_error():
    with pytest.raises(AudioFileError, match="held no sound"):
        list(PcmSource(io.BytesIO(b"")))


def test_stdout_gets_exact_pcm_and_counts_clipping():
    out = io.BytesIO()
    with PcmSink(out) as sink:
        sink.write(np.array([0.5, -1.0, 2.0], np.float32))
    np.testing.assert_array_equal(np.frombuffer(out.getvalue(), "<i2"), [16384, -32768, 32767])
    assert sink.clipped == 1 and "1 of 3" in sink.notes[0]


def test_stdout_never_gets_nan():
    with pytest.raises(SignalError, match="nan at sample 1"):
        PcmSink(io.BytesIO()).write(np.array([0, np.nan], np.float32))


def test_a_reader_that_goes_away_ends_the_output_quietly():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as stream, PcmSink(stream) as sink:
        sink.write(np.zeros(100, np.float32))
        sink.write(np.zeros(100, np.float32))
    assert sink.finished and sink.written == 0 and "stopped reading" in sink.notes[0]


def test_a_full_disk_behind_stdout_is_one_line():
    with open("/dev/full", "wb", buffering=0) as stream, pytest.raises(AudioFileError, match="No space left"):
        PcmSink(stream).write(np.zeros(100, np.float32))


@pytest.mark.parametrize(
    "wanted, kind, index",
    [
        ("3", "input", 3),
        (4, "output", 4),
        ("speak", "output", 1),
        ("LINE", "input", 2),
        ("robot", "output", 4),
        (None, "input", 6),
        ("mic", "input", 6),
    ],
)
def test_a_device_is_found_by_number_name_or_part_of_it(wanted, kind, index):
    assert match(DEVICES, wanted, kind, default=6).index == index


@pytest.mark.parametrize("wanted, kind, words", [
    ("trumpet", "input", "'trumpet' is unknown; expected one of 0 'USB Audio: mic'"), ("9", "input", "'9' is unknown"),
    ("usb", "input", "ambiguous; it matches 0 'USB Audio: mic', 2 'USB Audio: line'"), ("1", "input", "'1' is unknown"),
])  # fmt: skip
def test_a_device_that_is_not_clear_is_answered_with_names(wanted, kind, words):
    with pytest.raises(UsageError, match=words):
        match(DEVICES, wanted, kind, -1)


PHONE = "usb-Acme_Speakerphone-00"
SERVED = [
    Device(0, "pulse", 32, 32, 44100.0), Device(1, "default", 32, 32, 44100.0), Device(2, "HDA Intel", 2, 2, 48000.0),
    *(Device(0, name, inputs, 32 - inputs, 44100.0, pulse_name=name)
      for name, inputs in ((f"alsa_input.{PHONE}", 32), (f"alsa_output.{PHONE}", 0), (f"alsa_output.{PHONE}.monitor", 32),
                           ("alsa_input.pci-0000", 32), ("alsa_output.pci-0000.monitor", 32))),
]  # fmt: skip


@pytest.mark.parametrize(
    "wanted, kind, name",
    [
        ("speakerphone", "input", "alsa_input.usb-Acme_Speakerphone-00"),  # and not its monitor
        ("acme speakerphone", "output", "alsa_output.usb-Acme_Speakerphone-00"),
        ("Acme_Speakerphone-00.monitor", "input", "alsa_output.usb-Acme_Speakerphone-00.monitor"),
        ("pci-0000", "input", "alsa_input.pci-0000"),
        ("hda", "input", "HDA Intel"),
        ("2", "input", "HDA Intel"),
        ("mic", "input", "default"),
    ],
)
def test_a_part_of_a_sound_servers_name_is_enough(wanted, kind, name):
    assert match(SERVED, wanted, kind, default=1).name == name


def test_an_unknown_device_is_answered_with_the_names_that_work_and_not_with_the_way_to_the_server():
    with pytest.raises(UsageError, match="expected one of 'alsa_input.usb-Acme_Speakerphone-00'") as caught:
        match(SERVED, "trumpet", "input", -1)
    assert "'pulse'" not in str(caught.value) and "'default'" not in str(caught.value)
    assert "2 'HDA Intel'" in str(caught.value)
    with pytest.raises(UsageError, match="ambiguous; it matches 'alsa_input.usb.*', 'alsa_input.pci"):
        match(SERVED, "alsa_input", "input", -1)


def test_no_device_at_all_is_said():
    with pytest.raises(DeviceError, match="no sound device with an input"):
        match([], None, "input", -1)


def test_monitors_are_found_by_the_names_of_each_sound_system():
    assert monitor(DEVICES, DEVICES[1]).index == 3
    assert monitor(DEVICES, DEVICES[4]).index == 5
    with pytest.raises(UsageError, match="more than one possible monitor"):
        monitor(DEVICES, DEVICES[6])
    with pytest.raises(UsageError, match="has no monitor"):
        monitor(DEVICES[:3], DEVICES[1])


@pytest.mark.parametrize(
    ("module", "said"),
    [
        (
            "raise OSError('PortAudio library not found')",
            "live audio needs the PortAudio library (PortAudio library not found): apt install libportaudio2",
        ),
        (
            "class PortAudioError(Exception): pass\nraise PortAudioError('Error initializing PortAudio:\\n host error')",
            "PortAudio cannot be started (Error initializing PortAudio: host error): check the configuration of the"
            " sound system",
        ),
    ],
    ids=["is not there", "cannot be started"],
)
def test_a_portaudio_that_is_missing_or_cannot_be_started_is_one_line(tmp_path, module, said):
    (tmp_path / "sounddevice.py").write_text(module)
    code = (
        "from edgefilter.audio.device import list_devices\ntry: list_devices()\nexcept Exception as e:"
        " print(type(e).__name__, e)"
    )
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{Path(__file__).parents[2]}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == f"DeviceError {said}\n"


def test_inlet_keeps_the_place_of_what_it_lost():
    inlet = Inlet(10)
    inlet.receive(np.arange(1, 9, dtype=np.float32))
    inlet.receive(np.arange(9, 15, dtype=np.float32))
    np.testing.assert_array_equal(inlet.take(), [*range(1, 11), 0, 0, 0, 0])
    inlet.receive(np.array([15.0], np.float32), flagged=True, at=7.0)
    np.testing.assert_array_equal(inlet.take(), [15])
    assert inlet.lost == 4 and inlet.flags == 1 and inlet.received == 15
    assert inlet.latest == (15, 7.0)


def ramp(count):
    return np.arange(1, count + 1, dtype=np.float32)


def paired(pairing, mic_chunks, ref_chunks):
    """Both, as far as they are paired by a microphone that waits for its reference as long as a device's does."""
    parts = [(np.zeros(0, np.float32), np.zeros(0, np.float32))]
    for mic, ref in zip(mic_chunks, ref_chunks):
        pairing.hear(mic)
        pairing.play(ref)
        waiting = len(pairing.mic)
        parts.append(pairing.pair(max(min(waiting, pairing.known), waiting - MAX_WAIT)))
    return [np.concatenate(side) for side in zip(*parts)]


def test_uneven_callbacks_pair_sample_for_sample():
    x = ramp(60000)
    cuts = np.sort(np.random.default_rng(3).integers(0, 60000, 99))
    ref = [np.zeros(0, np.float32), *np.split(x, cuts)[:-1]]  # always one callback behind
    pairing = Pairing()
    got_mic, got_ref = paired(pairing, np.split(x, cuts), ref)
    np.testing.assert_array_equal(got_mic, got_ref)
    np.testing.assert_array_equal(got_mic, x[: got_mic.size])
    assert pairing.played == got_mic.size and pairing.filled == pairing.skipped == pairing.inserted == 0


def test_a_stalled_reference_is_filled_and_its_late_samples_do_not_shift_the_rest():
    x = ramp(20 * 1000)
    late = np.concatenate(np.split(x, 20)[5:12])
    ref = [late if i == 11 else part[:0] if 5 <= i < 11 else part for i, part in enumerate(np.split(x, 20))]
    pairing = Pairing()
    got_mic, got_ref = paired(pairing, np.split(x, 20), ref)
    np.testing.assert_array_equal(got_mic, x)
    assert pairing.filled == 6000 - MAX_WAIT
    stood_in = slice(5000, 5000 + pairing.filled)
    assert not got_ref[stood_in].any()
    expected = x.copy()
    expected[stood_in] = 0
    np.testing.assert_array_equal(got_ref, expected)


@pytest.mark.parametrize("first", ["microphone", "reference"])
def test_an_hour_that_both_have_lost_takes_neither_sound_nor_memory_whichever_tells_first(first):
    pairing, x, hour = Pairing(), ramp(9600), 3600 * 16_000
    parts = np.split(x, 6)
    before = paired(pairing, parts[:2], parts[:2])
    for by in (hour, -hour) if first == "microphone" else (-hour, hour):
        pairing.move(by)
    after = paired(pairing, parts[2:], parts[2:])
    np.testing.assert_array_equal(np.concatenate((before[1], after[1])), x)
    assert pairing.filled == pairing.inserted == 0


@pytest.mark.parametrize("queued", [1000, 5000])
def test_what_seemed_lost_at_the_microphone_is_paired_as_if_nothing_had_been_when_it_comes(queued):
    pairing, x = Pairing(late_is_lost=False), ramp(queued)
    pairing.play(x)
    pairing.hear(x[:600])
    np.testing.assert_array_equal(pairing.pair(600)[1], x[:600])
    np.testing.assert_array_equal(pairing.skip(200), x[600:800])
    assert pairing.skipped == 200
    pairing.put_back(300)  # no more than was skipped
    pairing.hear(x[600:1000])
    np.testing.assert_array_equal(*pairing.pair(400))
    assert pairing.skipped == 0 and pairing.queued == queued - 1000


def test_outlet_counts_an_underrun_once_and_waits_for_its_reserve():
    outlet = Outlet(100, margin=10)
    out = np.empty(8, np.float32)
    outlet.ring.write(ramp(12))
    outlet.deliver(out)
    np.testing.assert_array_equal(out, ramp(12)[:8])
    outlet.deliver(out)
    np.testing.assert_array_equal(out, [9, 10, 11, 12, 0, 0, 0, 0])
    outlet.ring.write(ramp(9))
    outlet.deliver(out)
    assert not out.any()
    outlet.ring.write(ramp(1))
    outlet.deliver(out)
    np.testing.assert_array_equal(out, ramp(8))
    assert outlet.underruns == 1 and outlet.missing == 12
