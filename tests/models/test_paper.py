"""The paper's networks: size, what they see, and what they do not depend on."""

from __future__ import annotations

import pytest
import torch

from endopilot.errors import InputError
from endopilot.models.config import WINDOW, TransformerConfig
from endopilot.models.paper import NETWORKS, ForwardNetwork, InverseNetwork, sinusoids


@pytest.fixture(params=["ff", "if"])
def network(request):
    torch.manual_seed(0)
    made = NETWORKS[request.param](TransformerConfig()).eval()
    torch.nn.init.normal_(made.head.weight, std=0.1)  # a fresh network gives the simple guess alone
    return made


def random_window(batch: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    motion = torch.randn(batch, WINDOW, 2, generator=generator)
    return 20 + motion.cumsum(1), 22 + motion.cumsum(1), torch.randn(batch, WINDOW, 2, generator=generator)


def test_parameters_as_counted_by_hand(network):
    d, f, features, outputs = 96, 128, 9, 2
    attention = 4 * (d * d + d)  # query, key, value, output
    feedforward = d * f + f + f * d + d
    norm = 2 * d
    encoder = 4 * (attention + feedforward + 2 * norm) + norm
    decoder = 4 * (2 * attention + feedforward + 3 * norm) + norm
    total = (features * d + d) + encoder + decoder + (d * outputs + outputs)
    assert total == 650_754
    assert sum(parameter.numel() for parameter in network.parameters()) == total


def test_an_untrained_network_holds_slack_and_offset():
    tip, proximal, control = random_window()
    forward = ForwardNetwork(TransformerConfig()).eval()
    expected = tip[:, -1] + torch.stack([0.5 * control[:, -1, 0], torch.zeros(3)], dim=-1)
    torch.testing.assert_close(forward(tip, proximal, control), expected)
    inverse = InverseNetwork(TransformerConfig()).eval()
    travel = (tip[:, -1, 0] - tip[:, -2, 0]) / 0.5
    expected = torch.stack([travel, torch.zeros(3)], dim=-1)
    torch.testing.assert_close(inverse(tip, proximal, control), expected)


def test_a_full_turn_of_the_history_changes_nothing(network):
    tip, proximal, control = random_window()
    turned = proximal + torch.tensor([0.0, 2 * torch.pi])
    torch.testing.assert_close(network(tip, proximal, control), network(tip, turned, control), atol=2e-5, rtol=0)
    half = proximal + torch.tensor([0.0, torch.pi])
    assert (network(tip, proximal, control) - network(tip, half, control)).abs().max() > 1e-3


def test_every_sample_of_the_window_and_their_order_count(network):
    window = [part.requires_grad_() for part in random_window(1)]
    found = network(*window)
    found.sum().backward()
    for part in window:
        assert part.grad is not None and (part.grad.abs().sum(dim=-1) > 0).all()
    order = torch.cat([torch.arange(WINDOW - 2).flip(0), torch.arange(WINDOW - 2, WINDOW)])
    assert (found - network(*(part[:, order] for part in window))).abs().max() > 1e-4


def test_positional_encoding_against_its_formula():
    encoding = sinusoids(30, 96)
    assert encoding[7, 0].item() == pytest.approx(torch.sin(torch.tensor(7.0)).item())
    angle = torch.tensor(7.0) / 10000 ** (10 / 96)
    assert encoding[7, 10].item() == pytest.approx(torch.sin(angle).item(), abs=1e-6)
    assert encoding[7, 11].item() == pytest.approx(torch.cos(angle).item(), abs=1e-6)


def test_scales_standardise(network):
    tip, proximal, control = (part.repeat(50, 1, 1) + torch.randn(150, WINDOW, 2) for part in random_window())
    truth = torch.randn(150, 2)
    network.fit_scales(tip, proximal, control, truth)
    scaled = (network.features(tip, proximal, control) - network.feature_mean) / network.feature_scale
    torch.testing.assert_close(scaled.flatten(0, 1).mean(0), torch.zeros(9), atol=1e-3, rtol=0)
    torch.testing.assert_close(scaled.flatten(0, 1).std(0), torch.ones(9), atol=1e-3, rtol=0)
    guess_loss = network.loss(network.guess(tip, proximal, control), truth)
    assert guess_loss.item() == pytest.approx(1.0, abs=1e-4)


def test_a_size_that_the_heads_do_not_share_is_refused():
    with pytest.raises(InputError, match=r"^d_model: "):
        TransformerConfig(d_model=100)
