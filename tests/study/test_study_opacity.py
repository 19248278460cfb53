"""The L1 penalty on opacities."""

import pytest
import torch

from kgs.study.rivals import opacity_l1


def test_against_scipys_ranks():
    stats = pytest.importorskip("scipy.stats")
    generator = torch.Generator().manual_seed(0)
    scores = torch.randint(0, 30, (200,), generator=generator).double()
    opacities = torch.rand(200, generator=generator, dtype=torch.float64)
    weights = (torch.from_numpy(stats.rankdata(scores.numpy())) - 0.5) / 200
    torch.testing.assert_close(opacity_l1(opacities, scores), (weights * opacities).mean(), rtol=1e-13, atol=0)


def test_gradcheck_and_no_gradient_for_scores():
    x = torch.rand(6, dtype=torch.float64, requires_grad=True)
    scores = torch.rand(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: opacity_l1(x, scores), (x,))
    opacity_l1(x, scores).backward()
    assert scores.grad is None


def test_no_gaussians_and_one():
    assert float(opacity_l1(torch.empty(0), torch.empty(0))) == 0.0
    assert float(opacity_l1(torch.tensor([0.8]), torch.tensor([5.0]))) == pytest.approx(0.4)


@pytest.mark.parametrize(("name", "x", "scores"), [("opacities", (3, 1), (3, 1)), ("scores", (3,), (4,))])
def test_other_shapes_are_refused(name, x, scores):
    with pytest.raises(ValueError, match=name):
        opacity_l1(torch.rand(x), torch.rand(scores))
