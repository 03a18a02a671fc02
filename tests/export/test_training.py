"""Dataset, network, losses and the training loop on seconds of sound."""

import json
import shutil
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest
import torch

from edgefilter.dsp.metrics import si_sdr as si_sdr_of_samples
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import UsageError
from edgefilter.types import Frame
from export import checkpoint, dataset, onnx_export, train
from export.crops import Batches, Shape, heed
from export.items import Items, mapped
from export.losses import LossWeights, power_law_loss, si_sdr, sound_loss, speech_loss
from export.network import MOST_LOGITS, EdgeConfig, EdgeCrnn, corrected, count, erb_bands, opened
from export.paper_network import PaperConfig
from export.tasks import FIRST_MASK, EdgeTask, PaperTask, filters_of
from export.trainer import Plan, optimisers
from tests.export.speech import write_librispeech, write_table
from tests.program import ROOT

SMALL = EdgeConfig(64, 32, channels=(4, 4, 4, 4), hidden=8)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    humans, robots = write_librispeech(folder / "humans", ("1", "2")), write_table(folder / "robots", ("a",))
    arguments = [
        "--humans",
        str(humans),
        "--robots",
        str(robots),
        *"--count 2 --seed 4 --jobs 1 --recipe paper --rooms 2".split(),
    ]
    arguments += ["--output", str(folder / "items")]
    dataset.main(arguments)
    before = (folder / "items" / "00001.npz").stat().st_mtime_ns
    dataset.main(arguments)
    assert (folder / "items" / "00001.npz").stat().st_mtime_ns == before  # a second run leaves what is there
    return folder / "items"


@pytest.mark.slow
def test_the_dataset_holds_what_the_linear_stage_left(data):
    items = Items(data)
    assert items.names == ["00000.npz", "00001.npz"]
    for name in items.names:
        crop = {signal: x[0].numpy() for signal, x in items.crops([(name, 3 * 16000)], 16000).items()}
        robot, left = crop["mic"] - crop["clean"], crop["error"] - crop["clean"]
        assert np.mean(left**2) < 0.2 * np.mean(robot**2)
    assert json.loads((data / "dataset.json").read_text())["seed"] == 4


def test_batches_are_consistent_after_augmentation(data):
    batch = Batches(Items(data), StftConfig(), Shape(4, 1.0), seed=1).draw(0)
    assert batch["error"].shape == batch["clean"].shape == (4, 61, 257, 2)
    assert batch["noise"].shape == batch["residual"].shape == (4, 61, 257)
    assert torch.allclose(batch["mic"] - batch["error"], batch["echo"], atol=1e-4)


def test_items_are_mapped_as_they_were_written_and_broken_ones_named(data, tmp_path):
    path = sorted(data.glob("*.npz"))[0]
    with np.load(path) as file:
        found = mapped(path)
        assert found.keys() == set(file.files)
        for name in file.files:
            assert found[name].dtype == file[name].dtype
            np.testing.assert_array_equal(found[name], file[name])
    broken = tmp_path / "broken.npz"
    whole = path.read_bytes()
    for content in (b"", b"no archive", whole[: len(whole) // 2]):
        broken.write_bytes(content)
        with pytest.raises(UsageError, match="not a whole simulated item"):
            mapped(broken)
    np.savez_compressed(broken, mic=np.zeros(9))
    with pytest.raises(UsageError, match="mic.npy is compressed"):
        mapped(broken)


def test_every_fourth_batch_is_of_few_long_crops_and_each_can_be_drawn_again(data):
    batches = Batches(Items(data), StftConfig(), Shape(8, 0.512), seed=1)
    found = [batches.draw(step) for step in range(5)]
    assert [len(batch["mic"]) for batch in found] == [8, 8, 8, 2, 8]
    assert found[3]["mic"].shape[1] == 4 * (found[0]["mic"].shape[1] + 1) - 1
    again = Batches(Items(data), StftConfig(), Shape(8, 0.512), seed=1).draw(2)
    assert all(torch.equal(again[name], tensor) for name, tensor in found[2].items())
    other = Batches(Items(data), StftConfig(), Shape(8, 0.512), seed=1, rank=1).draw(2)
    assert not torch.equal(other["mic"], again["mic"])


def test_expected_powers_belong_to_the_frames_beside_them(data):
    """An item's noise is told in bytes: half a step of 0.5 dB, and as many frames as the crop holds."""
    items, stft = Items(data), StftConfig()
    name = items.names[0]
    stored = np.load(data / name)["residual"]
    found = items.powers([(name, 10 * stft.hop)], 8 * stft.hop, stft)["residual"]
    assert found.shape == (1, 7, stft.bins)
    np.testing.assert_allclose(10 * np.log10(found[0, 0].numpy()), -90 + 0.5 * stored[11].astype(float), atol=1e-3)
    assert items.powers([(name, 0)], 8 * stft.hop, StftConfig(320, 160, 320)) == {}


def test_another_frequency_response_is_that_of_all_that_goes_through_it(data, monkeypatch):
    def drawn(share):
        monkeypatch.setattr("export.crops.COLOURED", share)
        return Batches(Items(data), StftConfig(), Shape(4, 1.0), seed=3).draw(0)

    def gain(name, *less):
        first, second = (each[name] - sum(each[other] for other in less) for each in (coloured, plain))
        return (first.square().sum((1, 3)) / second.square().sum((1, 3))).sqrt()[:, 1:]

    coloured, plain = drawn(1.0), drawn(0.0)
    heard = gain("echo")
    assert torch.allclose(gain("error", "clean"), heard, rtol=1e-2)
    for power in ("noise", "residual"):
        ratio = (coloured[power] / plain[power])[:, :, 1:]
        assert torch.allclose(ratio, heard.square()[:, None].expand_as(ratio), rtol=1e-2)
    for found in (heard, gain("clean") / heard, gain("reference")):
        db = 20 * torch.log10(found)
        assert 2.0 < db.abs().max() < 16.0 and (db[:, 1:] - db[:, :-1]).abs().max() < 2.0
    assert not torch.allclose(gain("clean"), heard, rtol=0.2) and not torch.allclose(gain("reference"), heard, rtol=0.2)


def test_a_swapped_human_is_as_loud_as_the_one_who_was_there(data, monkeypatch):
    def drawn(share):
        monkeypatch.setattr("export.crops.SWAPPED", share)
        monkeypatch.setattr("export.crops.COLOURED", 0.0)
        return Batches(Items(data), StftConfig(), Shape(16, 3.0), seed=3).draw(0)

    swapped, kept = drawn(1.0), drawn(0.0)
    power = [batch["clean"].square().sum((1, 2, 3)) for batch in (swapped, kept)]
    changed = [not torch.allclose(a, b) for a, b in zip(swapped["clean"], kept["clean"])]
    assert sum(changed) > 4
    assert torch.allclose(power[0], power[1], rtol=0.2)  # framing weighs the ends of a crop less
    rest = [batch["mic"] - batch["clean"] for batch in (swapped, kept)]
    assert torch.allclose(*rest, atol=1e-3)


def test_a_silent_robot_leaves_the_human_in_the_microphone(data, monkeypatch):
    monkeypatch.setattr("export.crops.ROBOT_SILENT", 1.0)
    batch = Batches(Items(data), StftConfig(), Shape(4, 1.0), seed=1).draw(0)
    assert not batch["reference"].any() and not batch["echo"].any()
    noise = (batch["mic"] - batch["clean"]).square().mean()
    assert 0 < noise < 1e-2 * batch["clean"].square().amax()
    heard = (batch["mic"] - batch["clean"]).square().sum(-1).mean()
    assert float(batch["noise"].mean() / heard) == pytest.approx(1.0, rel=0.1)  # 4 x 61 x 257 draws of an exponential


def spectra(frames=9, seed=0):
    """Four spectra and two powers, as the network takes them."""
    generator = torch.Generator().manual_seed(seed)
    powers = [0.01 * torch.rand(1, frames, 33, generator=generator) for _ in range(2)]
    return [0.1 * torch.randn(1, frames, 33, 2, generator=generator) for _ in range(4)] + powers


def awake(config=SMALL):
    """A network whose correction is not the zero that it begins with."""
    torch.manual_seed(1)
    network = EdgeCrnn(config).eval()
    for last in (network.mask, network.recognise[-1]):
        torch.nn.init.normal_(last.weight)
    return network


def test_before_training_the_answer_is_that_of_ss():
    stft, inputs = SMALL.stft, spectra(40)
    engine, state = SpectralSubtraction(stft), SpectralSubtraction(stft).initial_state()
    with torch.no_grad():
        found, second, _, _ = EdgeCrnn(SMALL).eval()(*inputs, EdgeCrnn(SMALL).initial_state())
    assert torch.equal(found, second)
    error, _, _, _, noise, residual = (x[0].numpy() for x in inputs)
    gains = []
    for t in range(40):
        spectrum = (error[t] @ (1, 1j)).astype(np.complex64)
        frame = Frame(spectrum, spectrum, spectrum, spectrum, noise[t], residual[t])
        wanted, state = engine.step(frame, state)
        gains.append(np.abs(wanted.spectrum / spectrum))
        # 0.995 is the largest gain that a correction can start from
        np.testing.assert_allclose(found[0, t].numpy() @ (1, 1j), wanted.spectrum, atol=6e-3 * np.abs(spectrum).max())
    assert np.ptp(gains) > 0.5


def test_bands_are_as_wide_as_the_ears_and_lose_no_frequency():
    spread = erb_bands(EdgeConfig().stft, 64)
    assert spread.shape == (64, 256) and (spread >= 0).all()
    assert torch.allclose(spread.sum(0), torch.ones(256))  # a mask of ones on the bands is one everywhere
    widths = (spread > 0).sum(1)
    assert widths[0] <= 2 and 20 < widths[-2] < 32  # a triangle of two steps of half an ERB, which is 865 Hz there


@pytest.mark.parametrize("erb", [0, 16])
def test_training_and_graph_see_the_same_whatever_the_memory_order(erb):
    network, inputs = awake(EdgeConfig(64, 32, channels=(4, 4, 4, 4), hidden=8, erb=erb)), spectra()
    with torch.no_grad():
        plain = network(*inputs, network.initial_state())[0]
        last = network.to(memory_format=torch.channels_last)(*inputs, network.initial_state())[0]
    assert torch.allclose(plain, last, atol=1e-6)


@pytest.mark.parametrize(("norm", "erb"), [("layer", 0), ("batch", 0), ("none", 0), ("layer", 16)])
def test_frame_by_frame_is_the_whole_clip(norm, erb):
    network = awake(EdgeConfig(64, 32, channels=(4, 4, 4, 4), hidden=8, norm=norm, erb=erb))
    inputs = spectra()
    with torch.no_grad():
        *sounds, logits, _ = network(*inputs, network.initial_state())
        state = network.initial_state()
        for t in range(9):
            *found, probability, state = network.step(*(x[:, t] for x in inputs), state)
            for sound, whole in zip(found, sounds, strict=True):
                assert torch.allclose(sound, whole[:, t], atol=1e-5)
            assert torch.allclose(probability, torch.sigmoid(logits[:, t]), atol=1e-5)


def test_the_future_does_not_change_the_past():
    network, inputs = awake(), spectra()
    with torch.no_grad():
        before, *_ = network(*inputs, network.initial_state())
        for x in inputs:
            x[:, 6:] += 1.0
        after, *_ = network(*inputs, network.initial_state())
    assert torch.equal(before[:, :6], after[:, :6])
    assert not torch.allclose(before[:, 6:], after[:, 6:])


def test_the_correction_never_amplifies_and_is_bounded():
    error = spectra()[0]
    prior = torch.rand(1, 9, 33).clamp(0.18, 0.995)
    human = corrected(prior, 100 * torch.randn(1, 9, 33, 2), error)
    assert (human.norm(dim=-1) <= error.norm(dim=-1) * (1 + 1e-6)).all()
    logits = torch.logit(opened(prior, torch.tensor(1e3)), 1e-9) - torch.logit(prior)
    assert torch.allclose(logits, torch.tensor(MOST_LOGITS), atol=0.1)
    unchanged = corrected(prior, torch.zeros(1, 9, 33, 2), error)
    assert torch.allclose(unchanged, prior.unsqueeze(-1) * error, atol=1e-6)


def counted_by_hand(config):
    """Parameters and multiply-accumulates a frame from the layers' sizes alone."""
    (a, b, c, d), f, hidden = config.channels, config.n_fft // 2, config.hidden
    down = [(15, a, 5, f // 2), (12, a, 5, f // 2)] + [(a, b, 5, f // 4)] * 2
    down += [(2 * b, c, 5, f // 8), (c, d, 5, f // 16)]
    up = [(2 * d, 2 * c, 3, f // 16), (2 * c, 2 * b, 3, f // 8), (3 * b, 2 * a, 3, f // 4), (3 * a, 2 * a, 3, f // 2)]
    masks = [(a, 2, 3, f), (a, a, 3, f), (a, 2, 3, f)]
    convolutions = [*down, *up, *masks]
    middle = d * f // 16
    linear, gru = 2 * middle * hidden + hidden, config.layers * 3 * hidden * 2 * hidden
    biases = sum(outputs for _, outputs, _, _ in convolutions) + hidden + middle + 1 + config.layers * 6 * hidden
    norms = sum(2 * outputs * frequencies for _, outputs, _, frequencies in (*down, *up))
    weights = sum(inputs * outputs * kernel for inputs, outputs, kernel, _ in convolutions)
    macs = sum(inputs * outputs * kernel * frequencies for inputs, outputs, kernel, frequencies in convolutions)
    return {"parameters": weights + biases + norms + linear + gru, "macs_per_frame": macs + linear + gru}


OTHER = EdgeConfig(channels=(8, 16, 24, 40), hidden=96, layers=1)


@pytest.mark.parametrize("config", [EdgeConfig(), SMALL, OTHER], ids=["default", "small", "other"])
def test_counts_are_those_of_the_layers_sizes(config):
    assert count(EdgeCrnn(config)) == counted_by_hand(config)


def test_the_shipped_network_is_as_large_as_its_page_says():
    figures, page = count(EdgeCrnn(EdgeConfig(erb=64))), (ROOT / "models" / "MODELS.md").read_text()
    millions, at_62_5_hz = figures["parameters"] / 1e6, figures["macs_per_frame"] * 62.5 / 1e6
    assert f"512/256 samples: {millions:.2f} M parameters, {at_62_5_hz:.0f} MMAC/s" in page


def test_the_loss_is_least_at_the_human_and_minds_suppression_more():
    clean = spectra(40, seed=3)[0] * 10

    def total(human):
        return float(sound_loss(human, clean, clean, LossWeights(si_sdr=0.0))["total"])

    assert total(clean) < total(0.7 * clean)
    quieter, louder = (
        total(0.5**2 * clean),
        total(clean * (2 - 0.25**0.3) ** (1 / 0.3)),
    )  # equal steps of the compressed magnitude
    assert quieter > 1.2 * louder


def test_the_head_answers_more_for_a_humans_first_words():
    """Three humans at 100 hops a second: one who was there before, one after a pause of 0.2 s, one after 2 s."""
    active = torch.zeros(1, 700)
    active[0, :100] = active[0, 120:200] = active[0, 400:402] = active[0, 405:500] = 1.0
    more = heed(active, hop=160)[0] > 1.0
    assert more.nonzero().flatten().tolist() == list(range(400, 430))


def test_a_frame_that_counts_more_moves_the_loss_more():
    active = torch.tensor([[1.0, 0.0, 0.0, 0.0]])

    def speech(wrong, weight):
        logit = torch.where(torch.arange(4) == wrong, -5.0, 5.0) * (2 * active - 1)
        return float(speech_loss(logit, active, weight))

    weight = torch.tensor([[4.0, 1.0, 1.0, 1.0]])
    assert speech(0, None) == pytest.approx(speech(1, None)) == pytest.approx(speech(0, torch.ones(1, 4)))
    assert speech(0, weight) == pytest.approx(4 * speech(1, weight), rel=0.02)


def test_a_share_of_the_fan_is_wanted_where_it_was_asked_for(data, monkeypatch):
    """The loss of a sound with as much of the fan as asked for is that of the human where nothing was asked for."""
    batch = Batches(Items(data), StftConfig(), Shape(2, 1.0), seed=1).draw(0)

    def losses(kept, answered):
        given = ["--data", "d", "--validation", "v", "--output", "r", "--si-sdr", "0"]
        given += ["--fan-kept", str(kept[0]), "--fan-recognised", str(kept[1])]
        task, sounds = EdgeTask(train.arguments(given)), [batch["clean"] + share * batch["fan"] for share in answered]
        monkeypatch.setattr(EdgeCrnn, "forward", lambda self, *_: (*sounds, torch.zeros(sounds[0].shape[:2]), ()))
        terms, _ = task.loss(task.network(), batch)
        return [float(terms[name]) for name in ("magnitude", "recognise")]

    for kept, answered in (((0.0, 0.0), (0.0, 0.0)), ((0.2, 1.0), (0.2, 1.0))):
        assert losses(kept, answered) == pytest.approx([0.0, 0.0], abs=1e-9)
    for kept, answered in (((0.2, 0.2), (0.0, 0.0)), ((0.0, 0.0), (0.2, 0.2)), ((0.2, 1.0), (1.0, 0.2))):
        assert min(losses(kept, answered)) > 1e-3


@pytest.mark.parametrize("option", ["--fan-kept", "--fan-recognised"])
@pytest.mark.parametrize("share", ["-0.1", "1.5"])
def test_a_share_of_the_fan_is_a_share(trained, capsys, option, share):
    assert trained("run", option, share) == 1
    assert f"{option} is {float(share):g}, expected 0 to 1" in capsys.readouterr().err


def test_si_sdr_of_spectra_is_that_of_samples():
    stft, rng = StftConfig(), np.random.default_rng(1)
    clean, noise = rng.standard_normal((2, 20 * 256)).astype(np.float32)
    pad = np.zeros(256, np.float32)

    def spectrum(x):
        frames = torch.from_numpy(np.concatenate((pad, x, pad))).unfold(0, 512, 256) * torch.from_numpy(
            stft.analysis_window
        )
        return torch.view_as_real(torch.fft.rfft(frames))[None]

    found = float(si_sdr(spectrum(clean + 0.3 * noise), spectrum(clean)))
    assert found == pytest.approx(si_sdr_of_samples(clean + 0.3 * noise, clean), abs=0.1)


def test_the_papers_loss_vanishes_at_the_right_mask():
    mixture = torch.rand(2, 5, 601) + 0.5
    assert float(power_law_loss(torch.full_like(mixture, 0.5), mixture, 0.5 * mixture)) == pytest.approx(0.0, abs=1e-10)
    assert float(power_law_loss(torch.ones_like(mixture), mixture, 0.5 * mixture)) > 0.01


def smoked(folder, name, *more):
    """Exit code of four steps of train.py into folder / name."""
    folders = ["--data", str(folder / "d"), "--validation", str(folder / "v"), "--output", str(folder / name)]
    return train.main([*folders, "--smoke", *more])


TINY = ("--hop", "32", "--channels", "4", "4", "4", "4", "--hidden", "8")
NARROW = ("--network", "paper", "--filters", "3", "2", "--lstm", "4", "--hidden", "5")


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A folder with a training of a network of each kind, "tiny" and "narrow"."""
    folder = tmp_path_factory.mktemp("begun")
    assert smoked(folder, "tiny", *TINY) == smoked(folder, "narrow", *NARROW) == 0
    return folder


@pytest.mark.slow
def test_a_network_that_learns_speech_like_another_keeps_its_sounds(begun, tmp_path):
    """Its own sounds cost nothing, others do; all layers learn speech, and the network that is the example learns nothing."""
    known = begun / "tiny" / "best.pt"
    folders = ["--data", str(tmp_path / "d"), "--validation", str(tmp_path / "v"), "--output", "r"]
    given = train.arguments([*folders, "--si-sdr", "0", "--like", str(known), *TINY])
    train.smoke(given)
    task, batch = EdgeTask(given), Batches(Items(given.data), SMALL.stft, Shape(2, 0.5), seed=1).draw(0)
    same = onnx_export.load(known).network.requires_grad_(True)
    terms, _ = task.loss(same, batch)
    assert terms["total"].item() == pytest.approx(task.weights.speech * terms["speech"].item(), abs=1e-6)
    terms["total"].backward()
    assert float(same.mic_1.convolution.weight.grad.abs().sum()) > 0.0
    assert not any(weight.requires_grad for weight in task.like.parameters())
    with torch.no_grad():
        same.mask.bias += 1.0
    others, _ = task.loss(same, batch)
    assert float(others["complex"]) > 1e-4 and float(others["recognise"]) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("name", "hop"), [("narrow", "32"), ("tiny", "16")])
def test_a_network_that_takes_other_spectra_is_no_example(begun, trained, capsys, name, hop):
    known = str(begun / name / "best.pt")
    assert trained("run", *TINY, "--hop", hop, "--like", known) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"train: --like {known} holds a network of another --network or --hop than this training's"


@pytest.mark.slow
def test_training_runs_stops_and_goes_on(begun, tmp_path, capsys):
    run = shutil.copytree(begun / "tiny", tmp_path / "run")
    steps = [json.loads(line)["step"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert steps == [2, 4]
    assert torch.load(run / "best.pt", weights_only=False)["config"]["n_fft"] == 64
    assert smoked(tmp_path, "run", *TINY) == 0
    assert "from step 4" in capsys.readouterr().out
    assert list(run.glob("events.*"))


def test_the_rate_rises_stays_and_falls():
    plan = Plan(steps=1000, rate=1.0, seed=1, every=100, patience=0)
    rates = [plan.rate_at(step) for step in range(1000)]
    assert rates[0] < 0.02 and max(rates) < 1.0001 and rates[-1] < 0.01
    assert all(rate > 0.999 for rate in rates[100:800]) and rates[899] == pytest.approx(0.505, abs=0.01)
    timed = Plan(steps=10**6, rate=1.0, seed=1, every=100, minutes=10)
    assert timed.rate_at(1000, 7 * 60) > 0.999 and timed.rate_at(1000, 9 * 60) == pytest.approx(0.5, abs=0.01)
    assert timed.done_at(1000, 10 * 60) == 1.0


@pytest.mark.slow
def test_training_starts_from_given_weights_of_the_same_shape(begun, trained, tmp_path, capsys):
    start = ("--start", str(begun / "tiny" / "best.pt"))
    first = torch.load(begun / "tiny" / "best.pt", weights_only=False)["network"]
    assert trained("second", *TINY, *start, "--rate", "0", "--seed", "5") == 0
    found = torch.load(tmp_path / "second" / "best.pt", weights_only=False)
    second, earlier = found["network"], torch.load(begun / "tiny" / "best.pt", weights_only=False)
    assert found["stages"][0] == {"steps": earlier["step"], "seed": earlier["seed"], "items": earlier["items"]}
    assert found["stages"][1]["seed"] == 5 and found["seed"] == [earlier["seed"], 5]
    assert found["step"] == earlier["step"] + found["stages"][1]["steps"] > earlier["step"]
    assert all(torch.allclose(first[name], second[name], atol=1e-4) for name in first)
    assert trained("third", *TINY, "--hidden", "12", *start) == 1
    assert "hidden=12" in capsys.readouterr().err
    start = ("--start", str(tmp_path / "bands" / "best.pt"), "--rate", "0")
    assert trained("bands", *TINY, "--erb", "16") == 0
    assert trained("other transform", *TINY, "--erb", "16", *start, "--hop", "20") == 0
    first, second = (torch.load(tmp_path / n / "best.pt", weights_only=False) for n in ("bands", "other transform"))
    assert (first["config"]["n_fft"], second["config"]["n_fft"]) == (64, 40)
    assert all(torch.allclose(first["network"][name], second["network"][name], atol=1e-4) for name in first["network"])
    assert trained("other bands", *TINY, "--erb", "32", *start) == 1
    assert "erb=16" in capsys.readouterr().err


@pytest.mark.slow
def test_small_weights_are_half_of_the_average_and_training_goes_on_from_them(
    begun, trained, tmp_path, monkeypatch, capsys
):
    last, weights = begun / "tiny" / "last.pt", tmp_path / "weights.pt"
    assert checkpoint.main([str(last), "--output", str(weights)]) == 0
    full, half = (torch.load(path, weights_only=True) for path in (last, weights))
    assert half["network"].keys() == full["network"].keys() and "resume" not in half and half["step"] == 4
    for name, value in half["network"].items():
        assert value.dtype == torch.float16 and torch.allclose(value.float(), full["network"][name], atol=2e-3)
    assert weights.stat().st_size < 0.3 * last.stat().st_size
    assert trained("second", *TINY, "--start", str(weights)) == 0
    second, mean = tmp_path / "second" / "last.pt", tmp_path / "mean.pt"
    assert checkpoint.main([str(second), "--output", str(mean), "--full", "--mean", str(last)]) == 0
    later, both = (torch.load(path, weights_only=True) for path in (second, mean))
    assert both["mean_of"] == [later["step"], 4] and both["stages"] == later["stages"]
    for name, value in both["network"].items():
        assert torch.allclose(value, (full["network"][name] + later["network"][name]) / 2, atol=1e-6)
    torch.save({**full, "config": {**full["config"], "hidden": 9}}, tmp_path / "wide.pt")
    assert checkpoint.main([str(last), "--output", str(mean), "--mean", str(tmp_path / "wide.pt")]) == 1
    assert "wide.pt" in capsys.readouterr().err
    monkeypatch.setattr(checkpoint, "MOST_BYTES", 1000)
    assert checkpoint.main([str(last), "--output", str(weights)]) == 1
    assert "expected at most" in capsys.readouterr().err and not weights.exists()


@pytest.fixture
def trained(tmp_path):
    """Four steps of train.py into tmp_path / name; its exit code."""
    return partial(smoked, tmp_path)


@pytest.mark.slow
def test_the_papers_network_trains_in_the_width_that_was_asked_for(begun):
    saved = torch.load(begun / "narrow" / "best.pt", weights_only=True)
    config = {"bins": 601, "filters": (3,) * 7 + (2,), "lstm": 4, "hidden": 5, "batch_norm": False}
    assert saved["kind"] == "paper" and saved["config"] == config
    assert saved["network"]["blstm.weight_hh_l0"].shape == (4 * 4, 4)
    assert all(torch.isfinite(value).all() for value in saved["network"].values())


def test_without_a_width_the_papers_network_is_that_of_table_1():
    given = "--data d --validation v --output r --network paper".split()
    assert PaperTask(train.arguments(given)).config() == asdict(PaperConfig())
    assert filters_of([16]) == (16,) * 7 + (2,) and filters_of([4]) == (4,) * 7 + (1,)


def test_before_training_the_papers_network_lets_through_as_much_as_there_is_of_the_human():
    given = ["--data", "d", "--validation", "v", "--output", "r", *NARROW]
    torch.manual_seed(0)
    with torch.no_grad():
        mask = PaperTask(train.arguments(given)).network()(*torch.rand(2, 1, 20, 601))
    assert float(mask.log().mean().exp()) == pytest.approx(FIRST_MASK, rel=0.5)  # random weights turn it a little
    assert 20 * np.log10(FIRST_MASK) == pytest.approx(-25)


@pytest.mark.slow
def test_a_training_of_the_papers_network_goes_on_in_its_own_width(trained, tmp_path, capsys):
    assert trained("run", *NARROW, "--norm", "batch") == 0
    assert trained("run", "--network", "paper") == 0
    assert "from step 4" in capsys.readouterr().out
    assert trained("more", "--network", "paper", "--start", str(tmp_path / "run" / "best.pt")) == 0
    configs = [torch.load(tmp_path / name / "last.pt", weights_only=True)["config"] for name in ("run", "more")]
    assert configs[0] == configs[1] and configs[0]["lstm"] == 4 and configs[0]["batch_norm"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--filters 4", "--filters is of --network paper, and this is --network edge: leave it out"),
        ("--lstm 4", "--lstm is of --network paper"),
        ("--network paper --channels 4 4 4 4", "--channels is of --network edge, and this is --network paper"),
        ("--network paper --erb 16", "--erb is of --network edge"),
        ("--network paper --like known.pt", "--like is of --network edge"),
        ("--network paper --norm layer", "--norm is layer, expected batch or none for --network paper"),
        ("--network paper --filters 4 4 4", "--filters has 3 numbers, expected one, or two"),
        ("--network paper --filters 4 0", "--filters has 0, expected 1 or more"),
        ("--network paper --lstm 0", "--lstm is 0, expected 1 or more"),
        ("--network paper --hidden -3", "--hidden is -3, expected 1 or more"),
    ],
)
def test_sizes_that_a_network_cannot_have_are_refused_in_one_line(trained, capsys, options, said):
    assert trained("run", *options.split()) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith(f"train: {said}") and "Traceback" not in "".join(lines)


@pytest.mark.slow
def test_a_folder_of_another_training_is_left_alone(begun, trained, tmp_path, capsys):
    shutil.copytree(begun / "narrow", tmp_path / "run")
    before = (tmp_path / "run" / "last.pt").read_bytes()
    assert trained("run", *NARROW, "--lstm", "6") == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "lstm=4" in said and "lstm=6" in said and "or another --output" in said
    assert trained("run", "--hop", "32") == 1
    assert "holds a network of kind paper, expected edge: give --network paper" in capsys.readouterr().err
    assert (tmp_path / "run" / "last.pt").read_bytes() == before


def test_every_weight_has_one_optimiser_and_every_matrix_the_one_for_matrices():
    network = EdgeCrnn(SMALL)
    muon, adam = optimisers(network, 1e-3)
    held = [{id(weight) for group in one.param_groups for weight in group["params"]} for one in (muon, adam)]
    assert held[0] | held[1] == {id(weight) for weight in network.parameters()} and not held[0] & held[1]
    assert {id(network.inward.weight), id(network.memory.weight_hh_l0)} <= held[0]
    assert {id(network.mask.weight), id(network.speech.weight), id(network.inward.bias)} <= held[1]


@pytest.mark.slow
@pytest.mark.parametrize("network", ["edge", "paper"])
def test_where_the_time_of_a_step_goes(data, network, monkeypatch, capsys, tmp_path):
    own = {"edge": ("--channels", "4", "4", "4", "4"), "paper": ("--filters", "3", "2", "--lstm", "4")}[network]
    folders = ("--data", str(data), "--validation", str(data), "--output", str(tmp_path))
    short = ("--hidden", "8", "--batch", "2", "--seconds", "0.5", "--long-every", "0", "--times")
    monkeypatch.setattr("export.step_times.TIMED", 2)
    assert train.main([*folders, "--network", network, *own, *short]) == 0
    head, *operations = capsys.readouterr().out.splitlines()
    assert float(head.split(" ms")[0].split()[-1]) > 0 and "2 steps" in head
    steps = {row[0]: row[-1] for line in operations if (row := line.split()) and row[-1].isdigit()}
    # which of torch's convolutions it is depends on the processor
    assert any("conv" in name and name.endswith("_backward") for name in steps)
    assert any(name.startswith("Optimizer.step") for name in steps)
    assert not list(tmp_path.glob("*.pt"))
