"""The L1 penalty on opacities."""

import pytest
import torch

from kgs.bench.study.rivals import opacity_l1


def test_weights_are_mid_ranks():
    scores = torch.tensor([10.0, -3.0, 0.5, 99.0], dtype=torch.float64)
    opacities = torch.tensor([0.1, 0.2, 0.4, 0.8], dtype=torch.float64)
    expected = (0.1 * 2.5 + 0.2 * 0.5 + 0.4 * 1.5 + 0.8 * 3.5) / 4 / 4
    assert float(opacity_l1(opacities, scores)) == pytest.approx(expected, rel=1e-14)


def test_against_scipys_ranks():
    stats = pytest.importorskip("scipy.stats")
    generator = torch.Generator().manual_seed(0)
    scores = torch.randint(0, 30, (200,), generator=generator).double()
    opacities = torch.rand(200, generator=generator, dtype=torch.float64)
    weights = (torch.from_numpy(stats.rankdata(scores.numpy())) - 0.5) / 200
    torch.testing.assert_close(opacity_l1(opacities, scores), (weights * opacities).mean(), rtol=1e-13, atol=0)


def test_equal_scores_weigh_the_same_and_the_mean_weight_is_a_half():
    for scores in (torch.zeros(7), torch.arange(7.0), torch.tensor([1.0, 1, 1, 2, 2, 3, 9])):
        x = torch.ones(7, requires_grad=True)
        loss = opacity_l1(x, scores)
        assert float(loss.detach()) == pytest.approx(0.5)
        loss.backward()
        for score in scores.unique():
            assert x.grad[scores == score].unique().numel() == 1


def test_the_order_of_the_gaussians_does_not_matter():
    generator = torch.Generator().manual_seed(1)
    scores, x = torch.rand(50, generator=generator), torch.rand(50, generator=generator)
    turn = torch.randperm(50, generator=generator)
    torch.testing.assert_close(opacity_l1(x, scores), opacity_l1(x[turn], scores[turn]))


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
