"""One step of message passing along a set of edges in one op: encoder, two layers, LayerNorm, sum at the receivers.

    z_m = of_senders[s] + of_receivers[r] + A2 relu(A1 e_m + a1), or + e_m where the edges carry latents
    message_m = LayerNorm(W2 relu(z_m) + b2; gamma, beta),    sum_r = sum of the messages over the edges into r

The C kernel allocates no array with a row of features for each edge. For the gradients it computes the layers again.

Legend: M edges, S senders, R receivers, E edge features, H channels of the encoder's hidden layer, F channels of
the first layer, F2 channels of a message. Without an encoder the op takes H = 0, and E = F for latents or E = 0.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops._edges import EdgeSet
from ast_sim.ops._mlp import layer_norm, layer_norm_backward, normalize

Encoder = tuple[Tensor, Tensor, Tensor]


def _compose(of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta, senders, receivers):
    """(sum, messages) from torch ops, which store every layer of every edge."""
    z = of_senders.index_select(0, senders) + of_receivers.index_select(0, receivers)
    if encoder is not None:
        A1, a1, A2 = encoder
        z = z + F.linear(F.relu(F.linear(edge_features, A1, a1)), A2)
    elif edge_features is not None:
        z = z + edge_features
    messages = layer_norm(F.linear(F.relu(z), W2, b2), gamma, beta)
    return messages.new_zeros(len(of_receivers), len(b2)).index_add(0, receivers, messages), messages


def _are_latents(edge_features: Tensor, a1: Tensor) -> bool:
    """Whether the edge features are latents, which are added without an encoder."""
    return len(a1) == 0 and edge_features.shape[1] > 0


_SPEC = (
    "of_senders[S,F], of_receivers[R,F], edge_features?[M,E], A1?[H,E] needs(edge_features), a1?[H] with(A1),"
    " A2?[F,H] with(A1), W2[G,F], b2[G], gamma[G], beta[G], senders[M] index(S), receivers[M] int64,"
    " receiver_offsets[R+1] offsets(M) segments(receivers)"
)
_kernel = library.Kernel("message", f"{_SPEC} -> sum[R,G], messages?[M,G]")
_backward_kernel = library.Kernel(
    "message_backward",
    f"{_SPEC}, dsum[R,G], dmessages?[M,G] -> dof_senders[S,F], dof_receivers[R,F], dedge_features?[M,E], dA1[H,E],"
    " da1[H], dA2[F,H], dW2[G,F], db2[G], dgamma[G], dbeta[G]",
)


def _check(kernel: library.Kernel, *tensors: Tensor) -> None:
    kernel.check(*tensors)
    inputs, channels = tensors[2].shape[1], tensors[0].shape[1]
    if len(tensors[4]) == 0 and inputs not in (0, channels):
        raise ValueError(
            f"message: edge_features without an encoder must have the {channels} channels of of_senders, not {inputs}"
        )


def _reference(*inputs):
    *tensors, with_messages = inputs
    _check(_kernel, *tensors)
    encoder = tensors[3:6]
    total, messages = _compose(*tensors[:3], None if _are_latents(tensors[2], encoder[1]) else encoder, *tensors[6:12])
    return total, messages if with_messages else messages.new_empty(0, messages.shape[1])


def _call_kernel(outputs, *inputs):
    *tensors, with_messages = inputs
    _kernel(*tensors, outputs[0], outputs[1] if with_messages else None)


def _new(of_senders, of_receivers, edge_features, A1, a1, A2, W2, b2, *edges):
    total = of_receivers.new_empty(of_receivers.shape[0], b2.shape[0])
    return total, of_receivers.new_empty(edge_features.shape[0] if edges[-1] else 0, b2.shape[0])


def _backward_reference(
    dsum, dmessages, P, Q, e, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, offsets, wants_edges
):
    _check(_backward_kernel, P, Q, e, A1, a1, A2, W2, b2, gamma, beta, senders, receivers, offsets)
    latents = _are_latents(e, a1)
    h = F.relu(F.linear(e, A1, a1))
    of_edges = e if latents else F.linear(h, A2)
    x = F.relu(P.index_select(0, senders) + Q.index_select(0, receivers) + of_edges)
    y = F.linear(x, W2, b2)
    g = dsum.index_select(0, receivers)
    if len(dmessages):
        g = g + dmessages
    dy, dgamma, dbeta = layer_norm_backward(g, gamma, *normalize(y))
    dz = (dy @ W2) * (x > 0)
    dc = (dz @ A2) * (h > 0)
    return (
        torch.zeros_like(P).index_add(0, senders, dz),
        torch.zeros_like(Q).index_add(0, receivers, dz),
        (dz if latents else dc @ A1) if wants_edges else e.new_empty(0, e.shape[1]),
        dc.T @ e,
        dc.sum(0),
        dz.T @ h,
        dy.T @ x,
        dy.sum(0),
        dgamma,
        dbeta,
    )


def _outputs(inputs, wants_edges: bool) -> list[Tensor]:
    """Tensors without values for the gradients of the ten float inputs."""
    shapes = [x.shape for x in inputs]
    if not wants_edges:
        shapes[2] = (0, shapes[2][1])
    return [x.new_empty(shape) for x, shape in zip(inputs, shapes, strict=True)]


def _call_backward(outputs, dsum, dmessages, *inputs):
    *tensors, wants_edges = inputs
    P, Q, e, *rest = outputs
    _backward_kernel(*tensors, dsum, dmessages if len(dmessages) else None, P, Q, e if wants_edges else None, *rest)


def _new_backward(dsum, dmessages, *inputs):
    return tuple(_outputs(inputs[:10], inputs[-1]))


_INPUTS = (
    "Tensor of_senders, Tensor of_receivers, Tensor edge_features, Tensor A1, Tensor a1, Tensor A2,"
    " Tensor W2, Tensor b2, Tensor gamma, Tensor beta, Tensor senders, Tensor receivers, Tensor receiver_offsets"
)
_message = library.define(f"message({_INPUTS}, bool with_messages) -> (Tensor, Tensor)", _reference, _new, _call_kernel)
_message_backward = library.define(
    f"message_backward(Tensor dsum, Tensor dmessages, {_INPUTS}, bool wants_edges) -> ({', '.join(['Tensor'] * 10)})",
    _backward_reference,
    _new_backward,
    _call_backward,
)


def _save(ctx, inputs, output) -> None:
    *tensors, ctx.with_messages = inputs
    ctx.save_for_backward(*tensors)


def _gradient(ctx, dsum, dmessages):
    if not ctx.with_messages:
        dmessages = dsum.new_empty(0, dsum.shape[1])
    wants_edges = ctx.needs_input_grad[2]
    gradients = list(_message_backward(dsum, dmessages, *ctx.saved_tensors, wants_edges))
    if not wants_edges:
        gradients[2] = None
    return *gradients, *[None] * 4


library.differentiate(_message, _save, _gradient)
library.differentiate_by_composition(_message_backward)


def _check_features(edges: EdgeSet, of_senders: Tensor, edge_features: Tensor | None, encoder: Encoder | None) -> None:
    """Raise ValueError for what the op cannot check, and for shapes that the composition would broadcast."""
    if encoder is not None:
        if edge_features is None:
            raise ValueError("message: an encoder needs edge_features; give them together, or no encoder")
        if len(encoder[1]) == 0:
            raise ValueError("message: a1 is empty: an encoder needs hidden channels, or give none")
    elif edge_features is not None and edge_features.shape != (len(edges), of_senders.shape[-1]):
        wanted, shape = f"[{len(edges)}, {of_senders.shape[-1]}]", tuple(edge_features.shape)
        raise ValueError(f"message: edge_features without an encoder must have shape {wanted}, not {shape}")


def _call(edges: EdgeSet, of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta, with_messages: bool):
    _check_features(edges, of_senders, edge_features, encoder)
    if library.BACKEND == "torch":
        inputs = (of_senders, of_receivers, edge_features, encoder, W2, b2, gamma, beta)
        return _compose(*inputs, edges.senders, edges.receivers)
    if edge_features is None:
        edge_features = of_senders.new_empty(len(edges), 0)
    if encoder is None:
        shapes = ((0, edge_features.shape[1]), (0,), (of_senders.shape[-1], 0))
        encoder = tuple(of_senders.new_empty(shape) for shape in shapes)
    lists = (edges.senders, edges.receivers, edges.receiver_offsets)
    return _message(of_senders, of_receivers, edge_features, *encoder, W2, b2, gamma, beta, *lists, with_messages)


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
