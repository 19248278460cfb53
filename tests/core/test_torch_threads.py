"""Torch's own operators on one thread, kernels on all."""

import pytest
import torch

from kgs._support.torch_threads import thread_count, torch_on_all_threads, torch_on_one_thread


def test_kernels_keep_their_threads_and_torch_gets_its_own_back(set_threads):
    set_threads(3)
    with torch_on_one_thread():
        assert (torch.get_num_threads(), thread_count()) == (1, 3)
        with torch_on_all_threads():
            assert (torch.get_num_threads(), thread_count()) == (3, 3)
        with torch_on_one_thread():
            assert (torch.get_num_threads(), thread_count()) == (1, 3)
        assert (torch.get_num_threads(), thread_count()) == (1, 3)
    assert (torch.get_num_threads(), thread_count()) == (3, 3)
    set_threads(2)
    assert thread_count() == 2


def test_an_error_inside_gives_the_threads_back(set_threads):
    set_threads(2)
    with pytest.raises(KeyError), torch_on_one_thread():
        raise KeyError
    assert (torch.get_num_threads(), thread_count()) == (2, 2)
