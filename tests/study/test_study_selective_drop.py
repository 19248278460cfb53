"""SelectiveDrop: which Gaussians go when a selection replaces chance."""

import copy
import pickle

import pytest
import torch

from kgs.study.rivals import SelectiveDrop


def layer(rate, scores):
    drop = SelectiveDrop(p=rate, schedule="constant")
    drop.scores = scores
    return drop


@pytest.mark.parametrize("shape", [(10,), (10, 1)])
def test_the_highest_scores_go_and_the_rest_is_scaled(shape):
    scores = torch.tensor([3.0, 9.0, 1.0, 7.0, 5.0, 0.0, 8.0, 2.0, 6.0, 4.0]).reshape(shape)
    out = layer(0.3, scores)(torch.full(shape, 0.7))
    expected = torch.full((10,), 0.7 / 0.7)
    expected[[1, 6, 3]] = 0.0
    torch.testing.assert_close(out, expected.reshape(shape))


def test_each_cameras_row_has_its_own_selection():
    scores = torch.tensor([[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]])
    out = layer(0.25, scores)(torch.ones(2, 4))
    assert (out == 0).tolist() == [[False, False, False, True], [True, False, False, False]]


def test_equal_scores_go_in_order_and_nothing_is_random():
    drop = layer(0.5, torch.zeros(6))
    for _ in range(3):
        assert drop(torch.ones(6)).tolist() == [0.0, 0.0, 0.0, 2.0, 2.0, 2.0]


def test_eval_is_the_identity_and_none_brings_chance_back():
    drop, x = layer(0.5, torch.arange(1000.0)), torch.ones(1000)
    assert drop.eval()(x) is x
    drop.train().scores = None
    assert 400 < int((drop(x)[:] == 0).sum()) < 600
    assert int((drop(x)[:500] == 0).sum()) > 0


def test_gradients_are_the_factor_or_zero():
    x = torch.full((4,), 0.3, requires_grad=True)
    layer(0.25, torch.tensor([0.0, 5.0, 1.0, 2.0]))(x).sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([4 / 3, 0.0, 4 / 3, 4 / 3]))


def test_scores_do_not_touch_the_stream_of_masks():
    plain, scored = (SelectiveDrop(p=0.4, schedule="constant", seed=3) for _ in range(2))
    scored.scores = torch.arange(50.0)
    scored(torch.ones(50))
    scored.scores = None
    assert torch.equal(plain(torch.ones(50)), scored(torch.ones(50)))


def test_they_are_plain_attributes():
    drop = layer(0.5, torch.arange(4.0))
    assert drop.state_dict() == {}
    assert list(drop.parameters()) == []
    for twin in (copy.deepcopy(drop), pickle.loads(pickle.dumps(drop))):
        assert twin(torch.ones(4)).tolist() == [2.0, 2.0, 0.0, 0.0]
    assert SelectiveDrop().scores is None
