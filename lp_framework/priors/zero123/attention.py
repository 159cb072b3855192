"""Attention of the U-Net: what its single condition token saves, and a choice of kernels."""

from __future__ import annotations

from typing import Any, Literal

from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

Attention = Literal["sdpa", "math"]


class SingleToken:
    """Cross-attention over one token.

    The softmax over a single key is 1 whatever the query, so every position receives the token's value: queries, keys
    and their products need not be computed.
    """

    def __call__(self, attn: Any, hidden_states: Tensor, encoder_hidden_states: Tensor, **unused: Any) -> Tensor:
        value = attn.to_out[0](attn.to_v(encoder_hidden_states))  # [B, 1, channels]
        return value.expand(-1, hidden_states.shape[1], -1)


class SelfAttention:
    """Self-attention by `scaled_dot_product_attention`, with PyTorch's plain kernel where a fused one cannot do."""

    def __init__(self, kernel: Attention) -> None:
        self.kernel = kernel

    def __call__(self, attn: Any, hidden_states: Tensor, **unused: Any) -> Tensor:
        query, key, value = (
            project(hidden_states).unflatten(-1, (attn.heads, -1)).transpose(1, 2)  # [B, heads, positions, channels]
            for project in (attn.to_q, attn.to_k, attn.to_v)
        )
        if self.kernel == "math" or forward_ad._current_level >= 0:  # fused kernels have no forward-mode derivative
            with sdpa_kernel(SDPBackend.MATH):
                mixed = functional.scaled_dot_product_attention(query, key, value)
        else:
            mixed = functional.scaled_dot_product_attention(query, key, value)
        return attn.to_out[0](mixed.transpose(1, 2).flatten(2))


def choose_attention(unet: Any, kernel: Attention) -> None:
    """Give a U-Net whose context is a single token these processors."""
    processors = {
        name: SingleToken() if name.endswith("attn2.processor") else SelfAttention(kernel)
        for name in unet.attn_processors
    }
    unet.set_attn_processor(processors)
