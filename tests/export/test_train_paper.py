"""The paper's network from data to a model that the engine runs."""

import conformance
import numpy as np
import pytest
import torch

from edgefilter.stream import enhance
from export import onnx_export, train_paper
from export.crops import Batches, Items
from export.train_paper import PAPER_STFT, PaperConfig, PaperCrnn, loss_of

SMALL = ["--filters", "2", "--lstm", "4", "--hidden", "8", "--rate", "0.01"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Four steps on noise, with what the command was given."""
    folder = tmp_path_factory.mktemp("paper")
    words = ["--data", str(folder / "d"), "--validation", str(folder / "v"), "--output", str(folder / "run"), *SMALL, "--smoke"]
    train_paper.main(words)
    return folder, words


def test_the_trained_network_becomes_a_model_that_the_engine_runs(trained):
    folder, _ = trained
    assert onnx_export.main([str(folder / "run/best.pt"), "--output", str(folder / "paper.onnx"), "--int8"]) == 0
    mic, ref = conformance.conversation(8000)
    for name in ("paper.onnx", "paper_int8.onnx"):
        out = enhance(mic, ref, engine="paper-crnn", model=folder / name)
        assert out.shape == mic.shape and 0 < np.abs(out).max() < 1


def test_a_second_call_goes_on_where_the_first_stopped(trained, capsys):
    folder, words = trained
    saved = torch.load(folder / "run/last.pt", weights_only=True)
    assert saved["step"] == 4
    train_paper.main(words)
    assert "from step 4" in capsys.readouterr().out
    assert list((folder / "run").glob("events.*"))


def test_the_loss_falls_on_one_batch(trained):
    torch.manual_seed(1)
    batches = Batches(Items(trained[0] / "d"), PAPER_STFT, 2, 0.5, seed=2, augment=False)
    batch = batches.draw()
    network = PaperCrnn(PaperConfig(filters=(2,) * 8, lstm=4, hidden=8))
    optimiser = torch.optim.Adam(network.parameters(), 0.01)
    losses = []
    for _ in range(15):
        loss = loss_of(network, batch, torch.device("cpu"))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]
