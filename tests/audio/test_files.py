"""Audio files in and out: conversions with their notes, every unusable file with its one line, and a disk that fills up."""

import os
import re
import resource
import signal
import subprocess
import sys

import numpy as np
import pytest
import soundfile

from edgefilter.audio import files
from edgefilter.audio.channels import Channels
from edgefilter.audio.files import Disk, FileSink, FileSource, Recorder, open_source, whole
from edgefilter.commands.display import write_json
from edgefilter.errors import AudioFileError, EdgefilterError, UsageError
from edgefilter.report.html import write_page
from edgefilter.report.plots import plot_before_after
from edgefilter.types import Block
from tests.program import ROOT


def noise(count, seed=0):
    return (np.random.default_rng(seed).integers(-9000, 9000, count) / 32768).astype(np.float32)


def read(source):
    blocks = list(source)
    assert [b.start for b in blocks] == list(np.cumsum([0] + [b.mic.size for b in blocks[:-1]]))
    return np.concatenate([b.mic for b in blocks]), np.concatenate([b.ref for b in blocks])


@pytest.mark.parametrize("suffix", [".wav", ".flac"])
def test_sixteen_bit_samples_survive_writing_and_reading_exactly(tmp_path, suffix):
    x = noise(10001)
    with FileSink(tmp_path / f"x{suffix}") as sink:
        for start in range(0, x.size, 777):
            sink.write(x[start : start + 777])
    source = FileSource(tmp_path / f"x{suffix}")
    mic, ref = read(source)
    np.testing.assert_array_equal(mic, x)
    assert not ref.any() and ref.size == x.size and source.total == x.size
    assert source.notes == ["no reference: nothing tells the robot's voice from the human's; give it with --reference"]


@pytest.mark.parametrize("rate", [8000, 11025, 22050, 44100, 48000, 96000])
@pytest.mark.parametrize("count", [3, 999, 44101])
def test_length_at_16_khz_is_exact_and_said(tmp_path, rate, count):
    soundfile.write(tmp_path / "x.wav", noise(count), rate)
    source = FileSource(tmp_path / "x.wav")
    mic, _ = read(source)
    assert mic.size == source.total == int(np.floor(count * 16000 / rate + 0.5))
    assert f"{rate} Hz resampled to 16000 Hz" in source.notes[0]


def test_a_tone_keeps_its_frequency_phase_and_level_through_the_resampler(tmp_path):
    soundfile.write(
        tmp_path / "x.wav", 0.5 * np.sin(2 * np.pi * 1000 * np.arange(44100) / 44100), 44100, subtype="FLOAT"
    )
    mic, _ = read(FileSource(tmp_path / "x.wav"))
    expected = 0.5 * np.sin(2 * np.pi * 1000 * np.arange(16000) / 16000)
    middle = slice(1000, -1000)  # away from the ends, where the tone begins abruptly
    assert np.abs(mic - expected)[middle].max() < 1e-5  # the resampler's 28 bits and float32


def test_channels_are_averaged_and_said(tmp_path):
    left, right = noise(500, 1), noise(500, 2)
    soundfile.write(tmp_path / "x.wav", np.stack((left, right), 1), 16000, subtype="FLOAT")
    source = FileSource(tmp_path / "x.wav")
    np.testing.assert_allclose(read(source)[0], (left + right) / 2, atol=1e-7)  # float32 rounding
    assert "2 channels averaged" in source.notes[0]


@pytest.mark.parametrize("count, words", [(700, "300 samples .* shorter"), (1300, "300 samples .* longer")])
def test_reference_of_another_length_is_fitted_and_said(tmp_path, count, words):
    mic, ref = noise(1000, 1), noise(count, 2)
    soundfile.write(tmp_path / "m.wav", mic, 16000)
    soundfile.write(tmp_path / "r.wav", ref, 16000)
    source = FileSource(tmp_path / "m.wav", tmp_path / "r.wav", block=64)
    got_mic, got_ref = read(source)
    np.testing.assert_array_equal(got_mic, mic)
    np.testing.assert_array_equal(got_ref, np.pad(ref, (0, 300))[:1000])
    assert re.search(words, source.notes[0])


def test_silent_reference_is_said(tmp_path):
    soundfile.write(tmp_path / "m.wav", noise(100), 16000)
    soundfile.write(tmp_path / "r.wav", np.zeros(100), 16000)
    assert "r.wav is silent" in FileSource(tmp_path / "m.wav", tmp_path / "r.wav").notes[0]


def broken(folder, kind):
    path = folder / f"{kind}.wav"
    if kind == "directory":
        path.mkdir()
    elif kind == "nothing":
        path.write_bytes(b"")
    elif kind == "header":
        soundfile.write(path, np.zeros(0), 16000)
    elif kind == "text":
        path.write_text("dear diary, this is not audio\n" * 20)
    elif kind in ("m4a", "webm"):  # as telephones and browsers record
        start = {"m4a": b"\x00\x00\x00\x1cftypM4A \x00\x00\x02\x00isomiso2", "webm": b"\x1aE\xdf\xa3\x9fB\x86\x81\x01"}
        path.write_bytes(start[kind] + bytes(1000))
    elif kind in ("nan", "inf"):
        x = noise(40000)
        x[34567] = float(kind)
        soundfile.write(path, x, 16000, subtype="FLOAT")
    elif kind == "scaled":
        soundfile.write(path, 1e6 * noise(40000) / np.abs(noise(40000)).max() * 1.01, 16000, subtype="FLOAT")
    elif kind.startswith("cut"):
        soundfile.write(path, noise(40000), 16000, format="FLAC" if kind == "cut-flac" else "WAV")
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind == "tiny":
        soundfile.write(path, np.ones(1) * 0.1, 44100)
    return path


@pytest.mark.parametrize(
    "kind, words",
    [
        ("missing", "does not exist"),
        ("directory", "is a directory"),
        ("nothing", r"empty \(0 bytes\)"),
        ("header", "0 samples"),
        ("text", "is not audio .*dear diary"),
        ("m4a", r"is an MPEG-4 file \(m4a, mp4\), expected WAV, FLAC or Ogg: .* ffmpeg -i \S+ \S+\.wav$"),
        ("webm", r"is a Matroska file .*ffmpeg -i \S+ \S+\.wav$"),
        ("nan", r"holds nan at sample 34567"),
        ("inf", r"holds inf at sample 34567"),
        ("scaled", r"holds -?1.01e\+06, expected samples of a full scale of 1: its scaling is wrong"),
        ("cut-wav", "truncated"),
        ("cut-flac", "truncated"),
        ("tiny", "holds 1 samples at 44100 Hz"),
    ],
)
@pytest.mark.parametrize("role", ["recording", "reference"])
def test_an_unusable_file_is_one_line_that_names_it(tmp_path, kind, words, role):
    soundfile.write(tmp_path / "good.wav", noise(100), 16000)
    paths = (broken(tmp_path, kind), tmp_path / "good.wav")
    with pytest.raises(AudioFileError, match=words) as caught:
        FileSource(*(paths if role == "recording" else paths[::-1]))
    assert str(caught.value).startswith(f"{role} {paths[0]}") and "\n" not in str(caught.value)


def test_a_wav_written_to_a_pipe_is_read_to_its_end(tmp_path):
    soundfile.write(tmp_path / "x.wav", noise(1000), 16000)
    data = bytearray((tmp_path / "x.wav").read_bytes())
    data[4:8] = data[40:44] = b"\xff" * 4
    (tmp_path / "x.wav").write_bytes(data)
    source = FileSource(tmp_path / "x.wav")
    np.testing.assert_array_equal(read(source)[0], noise(1000))
    assert "gives no length" in source.notes[0]


def test_one_sample_at_16_khz_is_a_recording(tmp_path):
    soundfile.write(tmp_path / "x.wav", np.full(1, 0.25), 16000)
    np.testing.assert_array_equal(read(FileSource(tmp_path / "x.wav"))[0], [0.25])


def test_clipped_samples_are_counted_and_said(tmp_path):
    with FileSink(tmp_path / "x.wav") as sink:
        sink.write(np.array([0.5, 1.5, -1.0, -2.0], np.float32))
    assert sink.clipped == 2 and "2 of 4 output samples" in sink.notes[0]
    np.testing.assert_allclose(soundfile.read(tmp_path / "x.wav")[0], [0.5, 32767 / 32768, -1.0, -1.0])


@pytest.mark.parametrize("suffix", [".wav", ".flac"])
def test_file_is_valid_after_an_interrupt(tmp_path, suffix):
    with pytest.raises(KeyboardInterrupt), FileSink(tmp_path / f"x{suffix}") as sink:
        sink.write(noise(5000))
        raise KeyboardInterrupt
    np.testing.assert_array_equal(read(FileSource(tmp_path / f"x{suffix}"))[0], noise(5000))


@pytest.mark.parametrize(
    "name, error, words",
    [
        ("x.mp3", UsageError, "expected .wav or .flac"),
        ("nowhere/x.wav", AudioFileError, "cannot be written: No such file"),
        ("full.wav", AudioFileError, "No space left on device"),
        ("full.flac", AudioFileError, "No space left on device"),
    ],
)
def test_a_place_that_takes_no_file_is_one_line(tmp_path, name, error, words):
    if name.startswith("full"):
        (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(error, match=words) as caught, FileSink(tmp_path / name) as sink:
        sink.write(noise(16000))
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".wav", ".flac"])
def test_what_fitted_on_a_full_disk_stays_a_valid_file(tmp_path, suffix):
    """A limit on file size fails a write as a full disk does, in its middle, and needs no disk."""
    path = tmp_path / f"x{suffix}"
    code = (
        "import os, sys, numpy as np\nfrom edgefilter.audio.files import FileSink\nfrom edgefilter.errors import"
        " AudioFileError\nx = np.load(sys.argv[2])\ntry:\n    with FileSink(sys.argv[1]) as sink:\n        for i in"
        " range(0, x.size, 256): sink.write(x[i:i + 256]); fitted = os.path.getsize(sys.argv[1])\n"
        "except AudioFileError as error: print(fitted, error)\n"
    )
    np.save(tmp_path / "x.npy", noise(160000))

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100001, 100001))

    command = [sys.executable, "-c", code, str(path), str(tmp_path / "x.npy")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, preexec_fn=limit)
    assert "cannot be written on" in done.stdout and str(path) in done.stdout and done.stdout.count("\n") == 1, (
        done.stderr
    )
    assert path.stat().st_size == int(done.stdout.split()[0])  # no part of the write that failed is left behind
    kept, _ = read(FileSource(path))
    assert kept.size > 45000  # nearly what 100001 bytes hold, less the write that failed
    np.testing.assert_array_equal(kept, noise(160000)[: kept.size])


@pytest.fixture
def small_disk():
    """No file of this process may be longer than so many bytes, which fails a write as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("suffix", [".wav", ".flac"])
def test_a_disk_on_which_not_even_the_header_fits_keeps_no_empty_file(tmp_path, small_disk, suffix):
    small_disk(10)
    with pytest.raises(AudioFileError, match="File too large"), FileSink(tmp_path / f"x{suffix}") as sink:
        sink.write(noise(16000))
    assert not list(tmp_path.iterdir())


def test_a_record_for_which_a_full_disk_has_no_room_leaves_no_empty_file(tmp_path, small_disk):
    small_disk(10)
    with pytest.raises(AudioFileError, match="mic.wav cannot be written on: File too large"):
        Recorder(tmp_path, 1)
    assert not list(tmp_path.iterdir())


def test_figures_pages_and_pictures_that_do_not_fit_on_a_disk_leave_no_part_behind(tmp_path, small_disk):
    small_disk(1000)
    text = 1000 * "too long "
    for write, name in (
        (lambda path: write_json({"text": text}, str(path)), "figures.json"),
        (lambda path: write_page(path, text), "page.html"),
        (lambda path: plot_before_after({"sound": noise(16000)}, path), "picture.png"),
    ):
        with pytest.raises(EdgefilterError, match="File too large"):
            write(tmp_path / name)
        assert not list(tmp_path.iterdir()), name


def test_an_interrupt_while_a_file_is_written_leaves_no_part_behind_nor_harms_a_device(tmp_path):
    (tmp_path / "null").symlink_to(os.devnull)
    for name in ("page.html", "null"):
        with pytest.raises(KeyboardInterrupt), whole(tmp_path / name, "the page") as file:
            file.write(b"the beginning")
            raise KeyboardInterrupt
    assert os.path.exists(os.devnull) and [path.name for path in tmp_path.iterdir()] == ["null"]


def test_recorder_keeps_the_exact_blocks(tmp_path):
    mic, ref = noise(999, 1) * np.float32(3.3), noise(999, 2) / np.float32(7)
    with Recorder(tmp_path / "deep" / "input", 1) as recorder:
        for at in (0, 500):
            recorder.write(Block(mic[at : at + 500], ref[at : at + 500], at))
            recorder.write_output(2 * mic[at : at + 500])
    source = FileSource(tmp_path / "deep/input/mic.wav", tmp_path / "deep/input/reference.wav")
    got_mic, got_ref = read(source)
    np.testing.assert_array_equal(got_mic, mic)
    np.testing.assert_array_equal(got_ref, ref)
    np.testing.assert_array_equal(read(FileSource(tmp_path / "deep/input/output.wav"))[0], 2 * mic)
    assert source.notes == [] and recorder.failure is None


def test_a_recording_longer_than_a_wav_file_can_be_ends_and_what_is_there_stays_valid(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_RECORDED", 1000)
    with Recorder(tmp_path, 1) as recorder:
        for at in range(0, 2000, 400):
            recorder.write(Block(noise(400), noise(400), at))
            recorder.write_output(noise(400))
    assert "mic.wav holds" in str(recorder.failure) and "ends here" in str(recorder.failure)
    assert {soundfile.info(tmp_path / f"{name}.wav").frames for name in ("mic", "reference", "output")} == {800}


def test_stop_ends_the_iteration(tmp_path):
    soundfile.write(tmp_path / "x.wav", noise(1000), 16000)
    source = FileSource(tmp_path / "x.wav", block=100)
    seen = 0
    for _ in source:
        seen += 1
        if seen == 3:
            source.stop()
    assert seen == 3


def test_stdin_with_a_second_reference_is_refused():
    with pytest.raises(UsageError, match="already holds the reference"):
        open_source("-", "r.wav")


WRITING = (
    "import os, sys, numpy as np\nfrom edgefilter.audio.files import FileSink\nx = np.load(sys.argv[2])\n"
    "sink = FileSink(sys.argv[1], float32='float' in sys.argv[1])\n"
    "for i in range(0, x.size, 256): sink.write(x[i:i + 256])\nos.kill(os.getpid(), 9)\n"
)


@pytest.mark.parametrize(("name", "missing"), [("x.wav", 0), ("float.wav", 0), ("x.flac", 4800)])
def test_a_killed_program_leaves_a_whole_file(tmp_path, name, missing):
    sound = noise(100_000)
    np.save(tmp_path / "x.npy", sound)
    command = [sys.executable, "-c", WRITING, str(tmp_path / name), str(tmp_path / "x.npy")]
    assert subprocess.run(command, cwd=ROOT).returncode == -signal.SIGKILL
    kept, _ = read(FileSource(tmp_path / name))
    assert kept.size >= sound.size - missing
    np.testing.assert_array_equal(kept, sound[: kept.size])


def test_a_file_that_is_being_written_is_left_alone(tmp_path):
    path = tmp_path / "x.wav"
    with FileSink(path) as first:
        first.write(noise(1000))
        with pytest.raises(AudioFileError, match="being written by another program .*name another file"):
            FileSink(path)
        first.write(noise(1000))
    assert FileSource(path).total == 2000
    with FileSink(path) as again:  # afterwards it is free
        again.write(noise(10))
    assert FileSource(path).total == 10


def test_a_wav_of_more_than_its_sizes_can_say_is_marked_as_going_on_to_the_end(tmp_path):
    disk = Disk(tmp_path / "x.wav")
    disk.write(b"RIFF\0\0\0\0WAVEfmt " + bytes(20) + b"data\0\0\0\0")
    os.truncate(tmp_path / "x.wav", 5 * 2**30)  # takes no room
    disk.finish()
    with open(tmp_path / "x.wav", "rb") as file:
        start = file.read(44)
    assert start[4:8] == start[40:44] == b"\xff" * 4


def test_channels_that_are_wanted_come_in_their_order(tmp_path):
    four = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 4)).astype(np.float32)
    soundfile.write(tmp_path / "four.wav", four, 16000, "FLOAT")
    source = FileSource(tmp_path / "four.wav", channels=Channels([2, 0], 3), block=700)
    blocks = list(source)
    assert source.microphones == 2 and source.notes[0].endswith("channels 2, 0 of 4")
    assert np.array_equal(np.concatenate([block.mic for block in blocks]), four[:, [2, 0]])
    assert np.array_equal(np.concatenate([block.ref for block in blocks]), four[:, 3])
    alone = np.concatenate([block.mic for block in FileSource(tmp_path / "four.wav", channels=Channels([1]))])
    assert np.array_equal(alone, four[:, 1])


def test_all_channels_of_a_file_are_microphones_where_that_is_asked(tmp_path):
    soundfile.write(tmp_path / "four.wav", np.arange(400, dtype=np.int16).reshape(-1, 4), 16000, "PCM_16")
    source = FileSource(tmp_path / "four.wav", channels=Channels())
    heard = np.concatenate([block.mic for block in source])
    assert source.microphones == 4 and source.notes[0].endswith("channels 0, 1, 2, 3 of 4")
    np.testing.assert_array_equal(heard * 32768, np.arange(400).reshape(-1, 4))
    soundfile.write(tmp_path / "nine.wav", np.zeros((400, 9)), 16000, "PCM_16")
    with pytest.raises(UsageError, match="nine.wav has 9 channels, expected at most 8 microphones"):
        FileSource(tmp_path / "nine.wav", channels=Channels())


def test_channels_are_resampled_together(tmp_path):
    t = np.arange(48000) / 48000
    sound = 0.3 * np.stack((np.sin(2 * np.pi * 440 * t), np.cos(2 * np.pi * 440 * t)), axis=1)
    soundfile.write(tmp_path / "two.wav", sound, 48000, "FLOAT")
    heard = np.concatenate([block.mic for block in FileSource(tmp_path / "two.wav", channels=Channels([0, 1]))])
    assert heard.shape == (16000, 2)
    assert np.allclose(heard[100:-100] ** 2 @ np.ones(2), 0.09, atol=1e-3)


def test_a_channel_that_is_not_there_is_one_line(tmp_path):
    soundfile.write(tmp_path / "two.wav", np.zeros((100, 2)), 16000)
    with pytest.raises(AudioFileError, match="has 2 channels, 0 to 1, found channel 2 asked for"):
        FileSource(tmp_path / "two.wav", channels=Channels([0, 2]))
    with pytest.raises(UsageError, match="stereo, microphone and reference, so its channels cannot be named"):
        open_source("-", channels=Channels([0]))


def test_several_channels_are_written_and_read_again(tmp_path):
    three = np.random.default_rng(1).uniform(-0.5, 0.5, (300, 3)).astype(np.float32)
    with FileSink(tmp_path / "three.wav", float32=True, channels=3) as sink:
        sink.write(three)
    assert sink.written == 300 and np.array_equal(soundfile.read(tmp_path / "three.wav", dtype="float32")[0], three)
