"""One step of message passing along a set of edges in one op: encoder, two layers, LayerNorm, sum at the receivers.

    z_m = of_senders[s] + of_receivers[r] + A2 relu(A1 e_m + a1), or + e_m where the edges carry latents
    message_m = LayerNorm(W2 relu(z_m) + b2; gamma, beta),    sum_r = sum of the messages over the edges into r

The C kernel allocates no array with a row of features for each edge. For the gradients it computes the layers again.

Legend: M edges, S senders, R receivers, E edge features, H channels of the encoder's hidden layer, F channels of
the first layer, F2 channels of a message. Without an encoder the op takes H = 0, and E = F for latents or E = 0.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops._edges import EdgeSet
from ast_sim.ops._mlp import layer_norm
from ast_sim.ops.derivatives import gradient_op
from ast_sim.ops.library import Kernel, Op
from ast_sim.ops.spec import Given, Sizes

Encoder = tuple[Tensor, Tensor, Tensor]


_INPUTS = (
    "of_senders[S,F], of_receivers[R,F], edge_features[M,E], A1[H,E], a1[H], A2[F,H], W2[G,F], b2[G], gamma[G],"
    " beta[G], senders[M] index(S), receivers[M] int64, receiver_offsets[R+1] offsets(M) segments(receivers)"
)
_SPEC = f"{_INPUTS}; with_messages switch -> sum[R,G], messages[M,G] if(with_messages)"
_BACKWARD_SPEC = (
    f"dsum[R,G] late, dmessages?[M,G] late, {_INPUTS}; wants_edges wants(edge_features)"
    " -> dof_senders[S,F], dof_receivers[R,F], dedge_features[M,E] if(wants_edges), dA1[H,E], da1[H], dA2[F,H],"
    " dW2[G,F], db2[G], dgamma[G], dbeta[G]"
)


def _check_latents(name: str, sizes: Sizes, given: Given) -> None:
    inputs, channels = sizes["E"], sizes["F"]
    if not sizes["H"] and inputs not in (0, channels):
        raise ValueError(
            f"message: edge_features without an encoder must have the {channels} channels of of_senders, not {inputs}"
        )


def _reference(
    of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, _, with_messages
):
    """From torch ops, which store every layer of every edge."""
    z = of_senders.index_select(0, senders) + of_receivers.index_select(0, receivers)
    if len(a1):
        z = z + F.linear(F.relu(F.linear(edge_features, A1, a1)), A2)
    elif edge_features.shape[1]:
        z = z + edge_features
    messages = layer_norm(F.linear(F.relu(z), W2, b2), gamma, beta)
    total = messages.new_zeros(len(of_receivers), len(b2)).index_add(0, receivers, messages)
    return total, messages if with_messages else None


_message = Op(Kernel("message", _SPEC, _check_latents), _reference)
_message_backward = gradient_op(_message, Kernel("message_backward", _BACKWARD_SPEC, _check_latents))


def _check_features(edges: EdgeSet, of_senders: Tensor, edge_features: Tensor | None, encoder: Encoder | None) -> None:
    """Raise ValueError for what the op cannot check, and for shapes that the composition would broadcast."""
    if encoder is not None:
        if edge_features is None:
            raise ValueError("message: an encoder needs edge_features; give them together, or no encoder")
        if len(encoder[1]) == 0:
            raise ValueError("message: a1 is empty: an encoder needs hidden channels, or give none")
    elif edge_features is not None and edge_features.shape != (edges.senders.shape[0], of_senders.shape[-1]):
        wanted = f"[{len(edges)}, {of_senders.shape[-1]}]"
        shape = tuple(edge_features.shape)
        raise ValueError(f"message: edge_features without an encoder must have shape {wanted}, not {shape}")


def _of_edges(
    edges: EdgeSet, of_senders: Tensor, edge_features: Tensor | None, encoder: Encoder | None
) -> tuple[Tensor, ...]:
    """The edge features and the encoder as the op takes them: empty where there are none."""
    if edge_features is None:
        edge_features = of_senders.new_empty(edges.senders.shape[0], 0)
    if encoder is not None:
        return edge_features, *encoder
    shapes = ((0, edge_features.shape[1]), (0,), (of_senders.shape[-1], 0))
    return edge_features, *(of_senders.new_empty(shape) for shape in shapes)


def _call(edges: EdgeSet, of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta, with_messages: bool):
    _check_features(edges, of_senders, edge_features, encoder)
    of_edges = _of_edges(edges, of_senders, edge_features, encoder)
    lists = (edges.senders, edges.receivers, edges.receiver_offsets)
    return _message(of_senders, of_receivers, *of_edges, W2, b2, gamma, beta, *lists, with_messages)


def message_sum(
    edges: EdgeSet,
    of_senders: Tensor,
    of_receivers: Tensor,
    edge_features: Tensor | None,
    encoder: Encoder | None,
    W2: Tensor,
    b2: Tensor,
    gamma: Tensor,
    beta: Tensor,
) -> Tensor:
    """The sum of LayerNorm(W2 relu(z_m) + b2) over the edges into each receiver, in stored order.

    Args:
        edges: M edges from S senders to R receivers.
        of_senders: [S, F], what the senders add to the first layer, W_s v_s.
        of_receivers: [R, F], what the receivers add to the first layer, W_r v_r, and the bias.
        edge_features: with an encoder its inputs [M, E]. Without one, what the edges add to the first layer [M, F],
            such as W_e e_m of latents e_m, or None.
        encoder: A1 [H, E], a1 [H] and A2 [F, H], or None.
        W2: [F2, F], as `torch.nn.Linear` holds it.
        b2: [F2].
        gamma: [F2], weight of the LayerNorm.
        beta: [F2], its bias.

    Returns:
        [R, F2]; 0 for a receiver without edges.

    Raises:
        ValueError: shapes do not fit each other or the edges.
    """
    return _call(edges, of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta, False)[0]


def message_edges(
    edges: EdgeSet,
    of_senders: Tensor,
    of_receivers: Tensor,
    edge_features: Tensor | None,
    encoder: Encoder | None,
    W2: Tensor,
    b2: Tensor,
    gamma: Tensor,
    beta: Tensor,
) -> tuple[Tensor, Tensor]:
    """`message_sum`, and the messages [M, F2], for models that keep latents on the edges."""
    return _call(edges, of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta, True)
