"""Whisper's encoder in torch against CTranslate2's, on a model of random weights, and the loss that listens through it."""

import ctranslate2
import numpy as np
import pytest
import torch
from ctranslate2.specs import whisper_spec

from bench.mel import mel_filters
from edgefilter.errors import ModelError
from export.network import EdgeConfig
from export.recogniser_loss import RecogniserLoss
from export.whisper_encoder import HOP, N_FFT, WhisperEncoder, parity, read_weights

WIDTH, HEADS, LAYERS, MELS = 64, 2, 2, 80


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A Whisper of two narrow layers as CTranslate2 writes it."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("whisper")
    spec = whisper_spec.WhisperSpec(LAYERS, HEADS, LAYERS, HEADS)

    def fill(part, *shape):
        part.weight = (rng.standard_normal(shape) / np.sqrt(np.prod(shape[1:]))).astype(np.float32)
        part.bias = (0.1 * rng.standard_normal(shape[0])).astype(np.float32)

    def norm(part):
        part.gamma = rng.uniform(0.5, 1.5, WIDTH).astype(np.float32)
        part.beta = (0.1 * rng.standard_normal(WIDTH)).astype(np.float32)

    def block(layer, across):
        for attention in [layer.self_attention, *([layer.attention] if across else [])]:
            norm(attention.layer_norm)
            sizes = [3 * WIDTH, WIDTH] if attention is layer.self_attention else [WIDTH, 2 * WIDTH, WIDTH]
            for part, size in zip(attention.linear, sizes):
                fill(part, size, WIDTH)
        norm(layer.ffn.layer_norm)
        fill(layer.ffn.linear_0, 4 * WIDTH, WIDTH)
        fill(layer.ffn.linear_1, WIDTH, 4 * WIDTH)

    fill(spec.encoder.conv1, WIDTH, MELS, 3)
    fill(spec.encoder.conv2, WIDTH, WIDTH, 3)
    for side, across, places in ((spec.encoder, False, 1500), (spec.decoder, True, 448)):
        side.position_encodings.encodings = rng.standard_normal((places, WIDTH)).astype(np.float32)
        norm(side.layer_norm)
        for layer in side.layer:
            block(layer, across)
    spec.decoder.embeddings.weight = rng.standard_normal((51865, WIDTH)).astype(np.float32)
    spec.decoder.projection.weight = spec.decoder.embeddings.weight
    spec.register_vocabulary([str(token) for token in range(51865)])
    spec.validate()
    spec.optimize()
    spec.save(str(path))
    return path


def test_all_layers_answer_as_ctranslate2s(folder):
    assert parity(folder) < 1e-3


def test_the_reader_takes_every_encoder_array_and_no_other(folder):
    found = read_weights(folder / "model.bin")
    assert found["conv1/weight"].shape == (WIDTH, MELS, 3) and int(found["num_heads"]) == HEADS
    assert sum(name.endswith("self_attention/linear_0/weight") for name in found) == LAYERS


def test_another_file_is_one_line(tmp_path, folder):
    cut = tmp_path / "model.bin"
    cut.write_bytes((folder / "model.bin").read_bytes()[:5000])
    with pytest.raises(ModelError, match="cut short"):
        read_weights(cut)
    cut.write_bytes(b"RIFF" + bytes(100))
    with pytest.raises(ModelError, match="expected 6"):
        read_weights(cut)


def test_mel_filters_are_triangles_of_equal_area_that_cover_the_band():
    filters = mel_filters(80, N_FFT)
    assert filters.shape == (80, 201) and (filters >= 0).all()
    wide = filters[40:]  # below, a triangle is narrower than three bins
    np.testing.assert_allclose(wide.sum(1) * 40.0, 1.0, rtol=0.08)
    assert (filters.sum(0)[2:-1] > 0).all()


def test_a_log_mel_spectrum_has_a_frame_each_10_ms_and_sees_a_tone_in_its_band(folder):
    tone = torch.sin(2 * torch.pi * 1000 * torch.arange(16000) / 16000)[None]
    log_mel = WhisperEncoder(folder).log_mel(tone)
    assert log_mel.shape == (1, MELS, 16000 // HOP)
    assert int(log_mel[0, :, 50].argmax()) == int(mel_filters(MELS, N_FFT)[:, 25].argmax())  # 1000 Hz is bin 25


def test_the_loss_vanishes_at_the_human_grows_with_the_robot_and_teaches(folder):
    loss, rng = RecogniserLoss(folder, EdgeConfig().stft), torch.Generator().manual_seed(0)
    clean, robot = 3 * torch.randn(2, 80, 257, 2, generator=rng), torch.randn(2, 80, 257, 2, generator=rng)
    heard = (clean + robot).requires_grad_()
    near, far = loss(heard, clean), loss(clean + 3 * robot, clean)
    assert float(loss(clean, clean)) < 1e-9 < float(near) < float(far)
    near.backward()
    assert torch.isfinite(heard.grad).all() and heard.grad.abs().sum() > 0
    assert float(loss(heard, torch.zeros_like(clean))) == 0.0


def test_half_precision_in_the_layers_leaves_the_loss_and_its_slope(folder):
    rng, slopes = torch.Generator().manual_seed(0), {}
    clean, robot = (torch.randn(2, 80, 257, 2, generator=rng) for _ in range(2))
    for half in (False, True):
        loss, heard = RecogniserLoss(folder, EdgeConfig().stft, half=half), (clean + robot).requires_grad_()
        value = loss(heard, clean)
        value.backward()
        slopes[half] = float(value.detach()), heard.grad.flatten()
    assert slopes[True][0] == pytest.approx(slopes[False][0], rel=0.02)
    assert torch.cosine_similarity(slopes[True][1], slopes[False][1], dim=0) > 0.98


def test_the_sound_of_spectra_is_what_they_were_cut_from(folder):
    loss = RecogniserLoss(folder, EdgeConfig().stft)
    stft, sound = loss.stft, np.random.default_rng(0).standard_normal(256 * 12).astype(np.float32)
    cut = np.stack([np.fft.rfft(sound[at : at + 512] * stft.analysis_window) for at in range(0, sound.size - 511, 256)])
    spectra = torch.view_as_real(torch.from_numpy(cut.astype(np.complex64)))[None]
    np.testing.assert_allclose(loss.sound(spectra)[0].numpy(), sound[256:-256], atol=1e-5)


def test_ctranslate2_takes_the_folder(folder):
    """Else the comparison above would compare with nothing."""
    assert ctranslate2.models.Whisper(str(folder)).n_mels == MELS
