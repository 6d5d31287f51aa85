"""The network of section 4.2.5 in torch: four features, one hidden sigmoid layer, one linear output, scaling inside."""

import math

import torch
from torch import Tensor, nn

from tormagd.element.model.features import FEATURES, Scaling
from tormagd.element.model.model_file import MAX_HIDDEN, ForceModel, ModelMetadata
from tormagd.element.physics.errors import require_that


class ForceNetwork(nn.Module):
    """From physical features (n x 4, order of `FEATURES`) to force in N (n)."""

    input_offset: Tensor
    input_gain: Tensor
    output_offset: Tensor
    output_gain: Tensor

    def __init__(self, scaling: Scaling, hidden: int = 50, *, seed: int = 0) -> None:
        super().__init__()
        require_that(1 <= hidden <= MAX_HIDDEN, "hidden", hidden, f"1 to {MAX_HIDDEN}")
        for name in ("input_offset", "input_gain", "output_offset", "output_gain"):
            self.register_buffer(name, torch.tensor(getattr(scaling, name), dtype=torch.float64))
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape: int) -> Tensor:
            return 2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1

        # A feature with gain 0 is no dimension to cover. The 2 turns the rule, made for tanh, into one for the sigmoid.
        varying = (self.input_gain != 0).to(torch.float64)
        reach = 2 * 0.7 * hidden ** (1 / max(int(varying.sum()), 1))
        direction = uniform(hidden, len(FEATURES)) * varying
        norm = direction.norm(dim=1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
        self.hidden_weight = nn.Parameter(reach * direction / norm)
        self.hidden_bias = nn.Parameter(reach * uniform(hidden))
        self.output_weight = nn.Parameter(uniform(hidden) / math.sqrt(hidden))
        self.output_bias = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def scale_inputs(self, features: Tensor) -> Tensor:
        return (features - self.input_offset) * self.input_gain

    def scale_output(self, force_N: Tensor) -> Tensor:
        return (force_N - self.output_offset) * self.output_gain

    def forward_scaled(self, inputs: Tensor) -> Tensor:
        hidden = torch.sigmoid(torch.addmm(self.hidden_bias, inputs, self.hidden_weight.T))
        return hidden @ self.output_weight + self.output_bias

    def forward(self, features: Tensor) -> Tensor:
        return self.forward_scaled(self.scale_inputs(features)) / self.output_gain + self.output_offset


def to_model(network: ForceNetwork, metadata: ModelMetadata) -> ForceModel:
    """Copy the weights into a model; the scaling has to be that of `metadata`."""
    return ForceModel(
        metadata=metadata,
        hidden_weight=network.hidden_weight.detach().double().numpy(),
        hidden_bias=network.hidden_bias.detach().double().numpy(),
        output_weight=network.output_weight.detach().double().numpy(),
        output_bias=float(network.output_bias.detach()),
    )


def to_network(model: ForceModel) -> ForceNetwork:
    network = ForceNetwork(model.metadata.scaling, model.metadata.hidden)
    with torch.no_grad():
        network.hidden_weight.copy_(torch.tensor(model.hidden_weight))
        network.hidden_bias.copy_(torch.tensor(model.hidden_bias))
        network.output_weight.copy_(torch.tensor(model.output_weight))
        network.output_bias.fill_(model.output_bias)
    return network
