"""The profile file: exact round trip, atomic write, and one line for whatever is not a profile."""

import io
import json
import os
import pickle
import resource
import signal
import zipfile

import numpy as np
import pytest

from edgefilter.cli import main
from edgefilter.dsp.stft import StftConfig
from edgefilter.echo.model import EchoModel
from edgefilter.errors import ProfileError
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import GRID_BINS, GRID_HZ, Profile
from edgefilter.profile.file import read_fields, write_fields
from edgefilter.profile.while_moving import WhileMoving
from edgefilter.types import PRE_ROLL

FIELDS = ("response", "noise_psd", "band_hz", "band_snr_db", "distortion_db")


def make(effects=(), **changes):
    rng = np.random.default_rng(7)
    path = rng.standard_normal(6400).astype(np.float32) * np.exp(-np.arange(6400, dtype=np.float32) / 400)
    values = {
        "delay": 431.25 + 1 / 3,
        "response": rng.random(GRID_BINS).astype(np.float32),
        "noise_psd": (rng.random(GRID_BINS) * 1e-8).astype(np.float32),
        "band_hz": np.array([[89.1, 112.2], [112.2, 141.3]]),
        "band_snr_db": np.array([12.5, 33.1]),
        "distortion_db": np.array([-31.0, -28.5, -45.2, -50.1]),
        "warnings": ("low SNR in 89-112 Hz", "übersteuert"),
        "created": "2026-01-02T03:04:05+00:00",
        "source": "S.wav, R.wav, FAN.wav",
    }
    return Profile(EchoModel(path, effects), **{**values, **changes})


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewrite(path, **changes):
    """The file at path with .npy members replaced by bytes or arrays (None: left out)."""
    content = members(path)
    for name, value in changes.items():
        if isinstance(value, np.ndarray):
            file = io.BytesIO()
            np.save(file, value)
            value = file.getvalue()
        content[f"{name}.npy"] = value
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in content.items():
            if value is not None:
                archive.writestr(name, value)


def edit_header(path, **changes):
    header = json.loads(bytes(np.load(path)["header"]))
    header.update(changes)
    rewrite(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8))


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "robot.npz"
    make((("playback_gain", {"gain_db": 1.5}),)).save(path)
    return path


def refused(path, match):
    with pytest.raises(ProfileError, match=match) as caught:
        Profile.load(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text and len(text) < 400
    return text


def same_effects(first, second):
    assert [name for name, _ in first] == [name for name, _ in second]
    for (_, a), (_, b) in zip(first, second, strict=True):
        assert list(a) == list(b)
        for key in a:
            assert type(a[key]) is type(b[key]) and np.array_equal(a[key], b[key]), key
            assert np.asarray(a[key]).dtype == np.asarray(b[key]).dtype, key


def test_round_trip_is_bit_exact_with_effects(tmp_path):
    curve = np.linspace(0, 1, 7) / 3
    room = {"rt60_s": 0.1 + 0.2, "taps": np.arange(50, dtype=np.float32) / 7}
    effects = (("late_reverb", room), ("mic_agc", {"gain_db": curve, "knots_hz": 3}))
    before = make(effects)
    before.save(tmp_path / "p.npz")
    after = Profile.load(tmp_path / "p.npz")
    for name in FIELDS:
        a, b = getattr(before, name), getattr(after, name)
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), name
    assert before.echo.impulse_response.tobytes() == after.echo.impulse_response.tobytes()
    for name in ("delay", "sample_rate", "warnings", "created", "source"):
        assert getattr(before, name) == getattr(after, name), name
    same_effects(effects, after.echo.effects)


def test_the_file_keeps_every_kind_of_number_and_shape_of_array(tmp_path):
    arrays = {"grid": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "none": np.zeros((0, 4), np.float32)}
    values = {**arrays, "on": True, "count": 3, "third": 1 / 3}
    effects = (("any", values), ("another", {"grid": np.arange(4, dtype=np.int8)}))
    write_fields(tmp_path / "f.npz", {"x": np.zeros(3)}, {"text": "übersteuert"}, effects)
    arrays, header, found = read_fields(tmp_path / "f.npz")
    assert list(arrays) == ["x"] and header == {"text": "übersteuert"}
    same_effects(effects, found)


@pytest.mark.parametrize("shape", ["(-601, -1)", "(601, -1, -1)", "(-1,)", "(True, 601)", "(601.0,)", "((601,),)"])
def test_an_array_of_a_shape_that_cannot_be_is_refused_in_one_line(saved, shape):
    body = np.load(saved)["response"].tobytes()
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    rewrite(saved, response=b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + body)
    refused(saved, "response.npy' (claims shape|is no .npy array)")


RECORDS = "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (3,)}"
HOSTILE_HEADERS = ["{", "(" * 2000, "{'descr': '<f4'", "\x00", "'" * 3, RECORDS, "[" * 60 + "]" * 60, "9" * 5000]


@pytest.mark.parametrize("text", HOSTILE_HEADERS, ids=range(len(HOSTILE_HEADERS)))
def test_an_array_with_a_header_that_is_none_is_refused_in_one_line(saved, text):
    rewrite(saved, response=b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode())
    refused(saved, "response.npy'")


@pytest.mark.parametrize(
    ("name", "values", "match"),
    [
        ("playback_gain", {"gain_db": "loud"}, "gain_db is str 'loud', expected a finite number or an array"),
        (
            "playback_gain",
            {"gain_db": 1e9},
            "playback_gain cannot be used .*gain_db is 1000000000.0 dB, expected -60 to 60",
        ),
        ("playback_gain", {"volume": 1.0}, "playback_gain cannot be used .*no parameter 'volume'"),
        ("playback_gain", {"gain_db": np.zeros(2)}, "playback_gain cannot be used"),
        (
            "delay_jump",
            {"times_s": np.array([0.01, 0.02, 0.03]), "samples": np.array([1.0, 2.0])},
            "delay_jump cannot be used",
        ),
        ("late_reverb", {"taps": np.full((3, 3), 0.1)}, "late_reverb cannot be used"),
        ("path_change", {"time_s": 100.0, "taps": np.full((3, 3), 0.1)}, "path_change cannot be used"),
        ("compression", {"ratio": np.array([2.0, 3.0])}, "compression cannot be used"),
    ],
)
def test_an_effect_value_that_cannot_be_applied_is_refused_in_one_line(saved, name, values, match):
    with np.load(saved) as content:
        header = json.loads(bytes(content["header"]))
    arrays = {f"effect_0_{key}": value for key, value in values.items() if isinstance(value, np.ndarray)}
    told = {
        key: {"array": f"effect_0_{key}"} if f"effect_0_{key}" in arrays else value for key, value in values.items()
    }
    header["effects"] = [{"name": name, "values": told}]
    rewrite(saved, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    refused(saved, match)


def test_saving_what_was_loaded_gives_the_same_bytes(saved, tmp_path):
    Profile.load(saved).save(tmp_path / "again.npz")
    assert members(saved) == members(tmp_path / "again.npz")


def test_fan_power_on_the_stft_grid_is_what_white_noise_of_that_psd_has():
    rng = np.random.default_rng(3)
    variance = 2.5e-5
    profile = make(noise_psd=np.full(GRID_BINS, variance / 8000, np.float32))
    stft = StftConfig()
    frames = rng.standard_normal((4000, stft.window_length)).astype(np.float32) * np.sqrt(variance)
    measured = np.mean(np.abs(np.fft.rfft(frames * stft.analysis_window)) ** 2, axis=0)
    expected = profile.noise_bins(stft)
    assert expected.shape == (stft.bins,) and expected.dtype == np.float32
    # 4000 independent frames: one sigma is 1.6 % (2.2 % at the real-valued first and last bin)
    np.testing.assert_allclose(measured, expected, rtol=0.1)


def test_response_is_exact_on_its_own_grid_and_interpolated_elsewhere():
    profile = make(response=(GRID_HZ / 8000).astype(np.float32))
    own = profile.response_bins(StftConfig(1200, 160, 1200, "hann"))
    assert np.array_equal(own, profile.response)
    # a straight line is interpolated exactly, to float32 rounding
    np.testing.assert_allclose(profile.response_bins(StftConfig()), np.arange(257) / 256, atol=1e-6)


@pytest.mark.parametrize("keep", [0, 1, 10, 200, 0.5, 0.99, -1])
def test_truncated(saved, keep):
    content = saved.read_bytes()
    saved.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    refused(saved, "not a profile|truncated or damaged")


def test_every_flipped_byte_is_refused_or_harmless(saved):
    content = bytearray(saved.read_bytes())
    rng = np.random.default_rng(1)
    for at in rng.integers(0, len(content), 150):
        damaged = content.copy()
        damaged[at] ^= 0xFF
        saved.write_bytes(damaged)
        try:
            profile = Profile.load(saved)
        except ProfileError as error:
            assert "\n" not in str(error)
        else:
            assert profile.delay == make().delay


def test_a_piece_cut_out_or_doubled_is_one_line(saved):
    """Found by random damage: zipfile sought before the file's beginning, or quoted a page of its bytes."""
    content = saved.read_bytes()
    for at in (30, 200, 1500, len(content) // 2):
        for size in (1, 4, 64, 1000):
            for damaged in (content[:at] + content[at + size :], content[: at + size] + content[at:]):
                saved.write_bytes(damaged)
                refused(saved, "truncated or damaged|no .npy array|claims shape|holds")


def test_a_named_pipe_in_place_of_a_profile_is_one_line_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / "pipe", "is no regular file")


def test_no_such_file_folder_and_other_types(tmp_path):
    refused(tmp_path / "absent.npz", "no such file")
    refused(tmp_path, "is a folder")
    other = tmp_path / "song.npz"
    other.write_bytes(b"RIFF\x00\x00\x00\x00WAVE")
    refused(other, "starts with b'RIFF'")
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme.txt", "hello")
    refused(other, "no .npy array")
    np.savez(other, x=np.zeros(3))
    refused(other, "version is missing")


def test_pickled_objects_are_never_loaded(saved, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "executed"),))

    rewrite(saved, response=np.array([Bomb()], dtype=object))
    refused(saved, "pickled objects")
    saved.write_bytes(pickle.dumps(Bomb()))
    refused(saved, "not a profile")
    assert not (tmp_path / "executed").exists()


def test_an_array_that_numpy_would_mend_is_refused_without_a_warning(saved, recwarn):
    """Found by random damage: Python 2's (601L,) was read with a warning on standard error."""
    name, content = next(entry for entry in members(saved).items() if b"(601,), }" in entry[1])
    rewrite(saved, **{name.removesuffix(".npy"): content.replace(b"(601,), }", b"(601L,),}")})
    refused(saved, "is no .npy array")
    assert not recwarn.list


def test_decompression_bomb_is_refused_without_unpacking(saved):
    with (
        zipfile.ZipFile(saved, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("bomb.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(64):
            member.write(bytes(2**20))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(saved, "unpacks to 67")
    # kilobytes; the bomb is 65536 of them
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20000


def test_array_that_claims_more_than_it_holds(saved):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (2**40,)})
    rewrite(saved, response=file.getvalue())
    refused(saved, "claims shape")


def test_huge_file(saved):
    with open(saved, "ab") as file:
        file.truncate(2**30)
    refused(saved, "1073741824 bytes long")


@pytest.mark.parametrize("value", [2, 0, -1, 2**40])
def test_another_version(saved, value):
    rewrite(saved, version=np.array(value))
    refused(saved, f"version is {value}, expected 1")


@pytest.mark.parametrize("name", [*FIELDS, "impulse_response"])
def test_missing_misshapen_and_not_finite_arrays(saved, name):
    original = saved.read_bytes()
    value = np.load(saved)[name]
    for change, match in [
        (None, f"missing: {name}"),
        (value[:-1] if name not in ("band_hz", "impulse_response") else value.reshape(2, -1).T[:1], name[:5]),
        (value.astype(np.int32), f"{name} is int32"),
        (
            np.where(np.arange(value.size).reshape(value.shape) == 1, np.nan, value).astype(value.dtype),
            f"{name} is nan at position 1",
        ),
        (np.full_like(value, np.inf), f"{name} is inf at position 0"),
        (np.full_like(value, 1e20), f"{name} is 1e\\+20"),
    ]:
        saved.write_bytes(original)
        rewrite(saved, **{name: change})
        refused(saved, match)


def test_nan_text_and_huge_header_values(saved):
    original = saved.read_bytes()
    for change, match in [
        ({"delay": float("nan")}, "not JSON"),
        ({"delay": "soon\nafter"}, "delay is 'soon"),
        ({"delay": 1e9}, "delay is 1000000000.0, expected -64000 to 64000"),
        ({"pre_roll": PRE_ROLL + 1}, f"pre_roll is {PRE_ROLL + 1}, expected {PRE_ROLL} samples"),
        ({"sample_rate": 44100}, "sample_rate is 44100, expected 16000 Hz"),
        ({"warnings": "text"}, "warnings is a JSON str"),
        ({"warnings": [1]}, "warnings is not all texts"),
        ({"created": 5}, "created is int"),
        ({"surprise": 5}, "unknown: surprise"),
        ({"effects": {}}, "not a list"),
        ({"effects": [{"name": 3, "values": {}}]}, "no name"),
        ({"effects": [{"name": "a", "values": {"b": [1]}}]}, "effects\\[0\\] \\(a\\).b is list"),
        ({"effects": [{"name": "a", "values": {"b": {"array": "effect_9_9"}}}]}, "not in the file"),
    ]:
        saved.write_bytes(original)
        edit_header(saved, **change)
        refused(saved, match)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"response": np.zeros(600, np.float32)}, "response is float32 of shape \\(600,\\)"),
        ({"noise_psd": np.full(601, -1e-9, np.float32)}, "noise_psd is -1e-09 at position 0, expected 0 to 1"),
        ({"delay": float("nan")}, "delay is nan"),
    ],
)
def test_construction_checks_too(changes, match):
    with pytest.raises(ProfileError, match=match):
        make(**changes)


def test_impulse_response_shorter_than_twice_the_pre_roll_is_refused():
    good = make()
    with pytest.raises(ProfileError, match="impulse_response"):
        Profile(EchoModel(np.ones(2 * PRE_ROLL - 1, np.float32)), good.delay, *(getattr(good, name) for name in FIELDS))


def test_effect_that_cannot_be_stored_leaves_the_old_file(saved):
    before = saved.read_bytes()
    for value in (np.array([1.0, np.nan]), float("inf"), object(), np.array([object()]), "loud"):
        with pytest.raises(ProfileError, match="cannot be stored"):
            make((("rattle", {"level": value}),)).save(saved)
    assert saved.read_bytes() == before and os.listdir(saved.parent) == ["robot.npz"]


def test_full_disk_leaves_the_old_file_and_no_rubbish(saved):
    """The file size limit makes write() fail half-way with a real OSError, as a full disk does."""
    before = saved.read_bytes()
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(ProfileError, match="cannot be written \\(File too large\\)"):
            make().save(saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert saved.read_bytes() == before and os.listdir(saved.parent) == ["robot.npz"]


def test_an_interrupt_while_a_profile_is_saved_leaves_the_old_file_and_no_rubbish(saved, monkeypatch):
    before = saved.read_bytes()

    def interrupt(file):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make().save(saved)
    assert saved.read_bytes() == before and os.listdir(saved.parent) == ["robot.npz"]


def test_a_profile_is_on_the_disk_before_it_takes_the_place_of_the_old_one(saved, monkeypatch):
    """After a power cut the name must not stand for a file that was never written."""
    happened, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (fsync(file), happened.append(os.fstat(file).st_size)))
    monkeypatch.setattr(os, "replace", lambda *names: (replace(*names), happened.append("replaced")))
    make().save(saved)
    assert happened == [saved.stat().st_size, "replaced"]


def test_the_silence_behind_a_room_takes_no_room_in_the_file(tmp_path):
    path = np.zeros(64_000, np.float32)
    path[PRE_ROLL] = 0.5
    profile = make()
    profile.with_echo(EchoModel(path)).save(tmp_path / "long.npz")
    profile.with_echo(EchoModel(path[: 2 * PRE_ROLL])).save(tmp_path / "short.npz")
    sizes = [(tmp_path / name).stat().st_size for name in ("long.npz", "short.npz")]
    assert sizes[0] < sizes[1] + path.nbytes // 100


def test_saving_does_not_open_all_files_of_other_threads_to_everybody(tmp_path, monkeypatch):
    """The umask belongs to the process: to read it is to change it, for as long as another thread may need to make a file."""
    before = os.umask(0o027)
    try:
        with monkeypatch.context() as changed:
            changed.setattr(os, "umask", lambda mask: pytest.fail(f"the whole process's umask was set to {mask:o}"))
            make().save(tmp_path / "p.npz")
        assert (tmp_path / "p.npz").stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


def test_a_name_as_long_as_a_file_system_takes_can_be_saved(tmp_path):
    name = "\N{ROBOT FACE}" * 62 + ".npz"  # 252 bytes of UTF-8
    make().save(tmp_path / name)
    assert Profile.load(tmp_path / name).delay == make().delay


def test_unwritable_targets(tmp_path):
    with pytest.raises(ProfileError, match="cannot be written \\(No such file or directory\\)"):
        make().save(tmp_path / "absent" / "p.npz")
    with pytest.raises(ProfileError, match="not a file that can be replaced"):
        make().save(tmp_path)
    with pytest.raises(ProfileError, match="not a file that can be replaced"):
        make().save("/dev/null")


def known_levels():
    density = np.full((2, GRID_BINS), 1e-9, np.float32)
    return LinearApproximation(np.array([-26.0, -20.0]), *[density] * 3, -density / 9, density, np.array([-40.0, -46]))


def known_motors():
    return WhileMoving(np.linspace(-1e-7, 1e-5, GRID_BINS, dtype=np.float32), 2.5, 14.25)


@pytest.mark.parametrize(
    ("part", "known", "left_out"),
    [("approximation", known_levels, "approximation_odd"), ("while_moving", known_motors, "moving_moments")],
)
def test_what_only_some_calibrations_measure_is_kept_and_a_part_of_it_is_refused(tmp_path, part, known, left_out):
    path = tmp_path / "p.npz"
    make(**{part: known()}).save(path)
    kept = getattr(Profile.load(path), part).arrays()
    for name, array in known().arrays().items():
        assert kept[name].dtype == array.dtype and kept[name].tobytes() == array.tobytes(), name
    rewrite(path, **{left_out: None})
    refused(path, f"array fields missing: {left_out}; give a profile")
    make().save(path)
    assert getattr(Profile.load(path), part) is None


@pytest.mark.parametrize(
    ("name", "array", "match"),
    [
        ("moving_density", np.zeros(600, np.float32), r"is float32 of shape \(600,\)"),
        ("moving_density", np.full(GRID_BINS, np.nan, np.float32), "is nan at position 0"),
        ("moving_moments", np.array(-1.0), "is -1 at position 0, expected 0 to"),
        ("moving_seconds", np.zeros(1), r"is float64 of shape \(1,\)"),
        ("approximation_level_db", np.array([-20.0, -26.0]), ".*expected rising levels"),
        ("approximation_level_db", np.zeros(0), ".*expected float64 of one level or more"),
        ("approximation_noise", np.zeros((2, 600), np.float32), r"is float32 of shape \(2, 600\)"),
        ("approximation_even", np.full((2, GRID_BINS), np.nan, np.float32), "is nan at position 0, expected -1e"),
        ("approximation_least_db", np.array([-40.0]), r"is float64 of shape \(1,\)"),
    ],
)
def test_a_damaged_part_of_what_moves_or_a_linear_path_leaves_is_one_line(tmp_path, name, array, match):
    make(while_moving=known_motors(), approximation=known_levels()).save(tmp_path / "p.npz")
    rewrite(tmp_path / "p.npz", **{name: array})
    refused(tmp_path / "p.npz", f"{name} {match}")


def test_what_a_frame_expects_of_motors_is_the_same_for_any_transform():
    narrow, wide = (StftConfig(n_fft=n, hop=n // 2, window_length=n) for n in (512, 1024))
    shares = np.exp(-np.square((narrow.frequencies - 1500.0) / 400.0)).astype(np.float32)
    kept = WhileMoving.learned(shares, narrow, 0.0, 1.0)
    np.testing.assert_allclose(kept.with_voice(narrow), shares, atol=0.01)
    assert kept.with_voice(wide).sum() == pytest.approx(shares.sum(), rel=0.01)
    assert kept.level_db == pytest.approx(10 * np.log10(shares.sum()), abs=0.1)


def test_the_effects_of_a_profile_are_told_in_figures_that_people_read_and_in_json_as_they_are(tmp_path, capsys):
    values = {"rt60_s": 0.61283746, "level_db": -9.000000123}
    bent = {"resonance_hz": 234.5678, "force_factor": np.array([0.123456, -0.000123456], np.float32)}
    make((("speaker_nonlinearity", bent), ("late_reverb", values | {"added": np.linspace(-1, 1, 50)}))).save(
        tmp_path / "p.npz"
    )
    assert main(["profile", "show", str(tmp_path / "p.npz")]) == 0
    said = capsys.readouterr().out
    assert "rt60_s = 0.613" in said and "level_db = -9, added = 50 values" in said
    assert "resonance_hz = 235" in said and "force_factor = (0.123, -0.000123)" in said
    assert main(["profile", "show", str(tmp_path / "p.npz"), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["effects"][1]["parameters"]["rt60_s"] == values["rt60_s"]
