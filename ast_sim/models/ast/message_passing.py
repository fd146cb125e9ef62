"""One step of message passing over one edge set (paper, equation Message-Passing).

    e'_ij = LN(f_e(e_ij, v_i, v_j)),    v'_j = LN(f_v(v_j, sum_i e'_ij))

Two identities of linear maps spare work without changing the result. The first layer of f_e acts on its inputs
separately, W [e, v_s, v_r] = W_e e + W_s v_s + W_r v_r, so W_s and W_r are applied to nodes, not to edges. And the
last layer of the edge encoder, e = A h + a, is used nowhere else, so W_e e = (W_e A) h + W_e a is one product instead
of two.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.layers import MLP
from ast_sim.ops import EdgeSet, linear, message_sum


class MessagePassing(nn.Module):
    """Messages from senders to receivers, both of width `hidden`.

    Args:
        config: its `hidden` and `factorized`.
        edge_inputs: width of the raw edge features, encoded by an MLP of their own; 0 for the edge-free form.
        residual: whether the receivers are added to the result.
    """

    def __init__(self, config: ASTConfig, edge_inputs: int, residual: bool):
        super().__init__()
        hidden = config.hidden
        factorized = config.factorized
        self.hidden = hidden
        self.residual = residual
        self.edge_encoder = MLP(edge_inputs, hidden, hidden, factorized) if edge_inputs else None
        self.f_e = MLP((3 if edge_inputs else 2) * hidden, hidden, hidden, factorized)
        self.f_v = MLP(2 * hidden, hidden, hidden, factorized)
        self.norm_e = nn.LayerNorm(hidden)
        self.norm_v = nn.LayerNorm(hidden)

    def forward(
        self, edges: EdgeSet, senders: Tensor, receivers: Tensor, edge_features: Tensor | None = None
    ) -> Tensor:
        """senders [S, hidden], receivers [R, hidden], edge_features [M, edge_inputs] -> [R, hidden]."""
        *of_edge, of_sender, of_receiver = self.f_e.first.weight.split(self.hidden, dim=1)
        constant = self.f_e.first.bias
        encoder = None
        if self.edge_encoder is not None:
            first = self.edge_encoder.first
            last = self.edge_encoder.second
            encoder = (first.weight, first.bias, of_edge[0] @ last.weight)
            constant = torch.addmv(constant, of_edge[0], last.bias)
        total = message_sum(
            edges,
            linear(senders, of_sender),
            linear(receivers, of_receiver, constant),
            edge_features,
            encoder,
            self.f_e.second.weight,
            self.f_e.second.bias,
            self.norm_e.weight,
            self.norm_e.bias,
        )
        residual = receivers if self.residual else None
        return self.f_v(receivers, beside=total, norm=self.norm_v, residual=residual)
