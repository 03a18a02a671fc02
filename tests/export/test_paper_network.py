"""The paper's network has the paper's layers, sizes and reach."""

import pytest
import torch
from torch import nn

from export.paper_network import PaperConfig, PaperCrnn, macs_per_frame, parameter_count

TINY = PaperConfig(bins=9, filters=(6,) * 8, lstm=8, hidden=16)


@pytest.mark.slow
def test_parameters_and_operations_are_those_of_table_1():
    with torch.device("meta"):
        network = PaperCrnn()
    conv = 2 * ((1 * 7 + 1) * 64 + (64 * 7 + 1) * 64 + 5 * (64 * 25 + 1) * 64 + (64 + 1) * 8)
    blstm = 2 * 4 * 400 * (2 * 8 * 601 + 400 + 2)
    dense = (800 + 1) * 600 + (600 + 1) * 601
    assert parameter_count(network) == conv + blstm + dense == 33_983_577
    per_frame = (
        2 * 601 * (7 * 64 + 7 * 64**2 + 5 * 25 * 64**2 + 64 * 8)
        + 2 * 4 * 400 * (2 * 8 * 601 + 400)
        + 800 * 600
        + 600 * 601
    )
    assert macs_per_frame(network) == per_frame
    assert round(100 * macs_per_frame(network) / 1e9) == 68  # a second


def test_eight_convolutions_a_branch_with_the_tables_widths_and_dilations():
    with torch.device("meta"):
        network = PaperCrnn()
    for branch in (network.mixture, network.reference):
        convolutions = [layer for layer in branch if isinstance(layer, nn.Conv2d)]
        assert [c.kernel_size for c in convolutions] == [(1, 7), (7, 1), (5, 5), (5, 5), (5, 5), (5, 5), (5, 5), (1, 1)]
        assert [c.dilation for c in convolutions] == [(1, 1), (1, 1), (1, 1), (2, 1), (4, 1), (8, 1), (16, 1), (1, 1)]
        assert [c.out_channels for c in convolutions] == [64] * 7 + [8]


def test_batch_normalisation_is_an_option_and_off():
    with torch.device("meta"):
        counts = [
            sum(isinstance(m, nn.BatchNorm2d) for m in PaperCrnn(PaperConfig(batch_norm=on)).modules())
            for on in (False, True)
        ]
    assert counts == [0, 16]


def test_the_mask_has_the_mixtures_shape_and_lies_between_0_and_1():
    torch.manual_seed(0)
    network = PaperCrnn(TINY).eval()
    mic, reference = torch.rand(2, 2, 30, 9)
    mask = network(mic, reference)
    assert mask.shape == (2, 30, 9)
    assert 0 <= mask.min() and mask.max() <= 1 and mask.std() > 0
    assert not torch.equal(mask, network(mic, torch.rand(2, 30, 9))), "the reference has no say"


def test_the_convolutions_reach_65_frames_to_each_side():
    """3 + 2 (1 + 2 + 4 + 8 + 16) = 65 frames, 650 ms."""
    torch.manual_seed(0)
    branch = PaperCrnn(TINY).mixture
    for layer in branch:
        if isinstance(layer, nn.Conv2d):
            nn.init.constant_(layer.weight, 1.0)
    x = torch.ones(1, 1, 201, 9, requires_grad=True)
    branch(x)[0, 0, 100].sum().backward()
    reached = torch.nonzero(x.grad[0, 0].sum(dim=1)).flatten()
    assert (reached.min().item(), reached.max().item()) == (35, 165)


def test_it_learns_a_mask_from_the_reference():
    torch.manual_seed(0)
    network = PaperCrnn(TINY)
    mic, reference = torch.rand(2, 1, 20, 9)
    target = mic * (reference < 0.5)
    optimiser = torch.optim.Adam(network.parameters(), 0.01)
    errors = []
    for _ in range(60):
        loss = torch.mean((network(mic, reference) * mic - target) ** 2)
        errors.append(loss.item())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert errors[-1] < 0.5 * errors[0]
