"""Layers: the written-out attention equals torch's own."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from surrogate.models.layers import attend


@pytest.mark.parametrize("masked", [False, True])
def test_attention_equals_torchs(masked: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    q, k, v = (torch.randn(3, 2, n, 8, generator=generator) for n in (5, 7, 7))
    mask = torch.rand(3, 1, 1, 7, generator=generator) < 0.6 if masked else None
    if mask is not None:
        mask[..., 0] = True
    expected = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    torch.testing.assert_close(attend(q, k, v, mask), expected, rtol=0, atol=1e-6)
    # Negative controls: keys matter, and so does the mask.
    assert (attend(q, k.flip(-1), v, mask) - expected).abs().max() > 1e-2
    if masked:
        assert (attend(q, k, v) - expected).abs().max() > 1e-2
