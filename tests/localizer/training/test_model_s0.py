"""The paper's network: shapes of Table 5, one function before and after fusing."""

from __future__ import annotations

import copy

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")
from localizer.training.models.networks import fuse  # noqa: E402
from localizer.training.models.s0 import (  # noqa: E402
    STRIDES,
    BranchedBlock,
    S0Config,
    S0Net,
)


@pytest.fixture(scope="module")
def trained():
    """Statistics and gains that are neither one nor zero, and keep activations in range."""
    torch.manual_seed(0)
    network = S0Net(S0Config())
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.2, 0.5)
            torch.nn.init.uniform_(module.bias, -0.3, 0.3)
            module.running_mean.uniform_(-0.3, 0.3)
            module.running_var.uniform_(0.5, 2.0)
    return network.eval()


@pytest.fixture(scope="module")
def fused(trained):
    return fuse(copy.deepcopy(trained)).eval()


@pytest.fixture(autouse=True)
def _the_same_images_in_any_order(trained):
    torch.manual_seed(1)


def test_levels_are_those_of_table_5(fused):
    with torch.no_grad():
        levels = fused(torch.rand(2, 3, 64, 96))
    for (features, confidence), stride in zip(levels, STRIDES, strict=True):
        assert features.shape == (2, 32, 64 // stride, 96 // stride)
        assert confidence.shape == (2, 64 // stride, 96 // stride)
        np.testing.assert_allclose(features.norm(dim=1), 1.0, atol=1e-4)
        assert 0 < confidence.min() < confidence.max() < 1


def test_fused_is_the_same_function(trained, fused):
    assert any(isinstance(m, BranchedBlock) for m in trained.modules())
    assert not any(isinstance(m, (BranchedBlock, torch.nn.BatchNorm2d)) for m in fused.modules())
    image = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        for before, after in zip(trained(image), fused(image), strict=True):
            for a, b in zip(before, after, strict=True):
                np.testing.assert_allclose(a, b, atol=1e-5)
