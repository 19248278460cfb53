"""Products inside are exact to their dtype, and what the program had set is as before."""

import os
import threading

import pytest
import torch

from kgs.full_precision import full_precision, in_full_precision

CPU = torch.device("cpu")


def bfloat16():
    return torch.autocast("cpu", torch.bfloat16)


def test_autocast_is_off_inside_and_on_again():
    a, b = torch.rand(9, 9), torch.rand(9, 9)
    with bfloat16():
        with full_precision(CPU):
            assert (a @ b).dtype == torch.float32
        assert (a @ b).dtype == torch.bfloat16


@pytest.mark.parametrize("precision", ["highest", "high", "medium"])
def test_the_precision_is_put_back(precision, matmul_precision):
    matmul_precision(precision)

    def fail():
        assert not rounded()
        raise KeyError

    with pytest.raises(KeyError), full_precision(CPU), full_precision(CPU):
        fail()
    assert torch.get_float32_matmul_precision() == precision


@pytest.mark.skipif(not hasattr(torch.backends.mkldnn, "matmul"), reason="torch before 2.9 has one setting")
def test_settings_of_single_backends_are_put_back(matmul_precision):
    for change in (
        lambda: setattr(torch.backends.mkldnn.matmul, "fp32_precision", "bf16"),
        lambda: setattr(torch.backends.cuda.matmul, "fp32_precision", "tf32"),
        lambda: setattr(torch.backends, "fp32_precision", "tf32"),
    ):
        matmul_precision("highest")
        change()
        before = settings()
        with full_precision(CPU):
            assert not rounded()
        assert settings() == before


def test_what_is_set_meanwhile_stays(matmul_precision):
    matmul_precision("medium")
    with full_precision(CPU):
        assert torch.get_float32_matmul_precision() == "highest"
        assert not torch.backends.cuda.matmul.allow_tf32
        torch.set_float32_matmul_precision("high")
    assert torch.get_float32_matmul_precision() == "high"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_while_somebody_is_inside(matmul_precision):
    matmul_precision("medium")
    with full_precision(CPU):
        child = os.fork()
        if child == 0:
            code = 1
            try:
                with full_precision(CPU):
                    inside = torch.get_float32_matmul_precision()
                code = 0 if (inside, torch.get_float32_matmul_precision()) == ("highest", "medium") else 2
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert torch.get_float32_matmul_precision() == "medium"


def test_the_last_thread_puts_it_back(matmul_precision):
    matmul_precision("medium")
    inside, leave = threading.Event(), threading.Event()

    def other():
        with full_precision(CPU):
            inside.set()
            leave.wait()

    thread = threading.Thread(target=other)
    with full_precision(CPU):
        thread.start()
        inside.wait()
    assert not rounded()
    leave.set()
    thread.join()
    assert torch.get_float32_matmul_precision() == "medium"


def test_gradients_are_in_full_precision_as_well():
    a, b, c = (torch.rand(3, 3, requires_grad=True) for _ in range(3))
    weights = torch.rand(3, 3)
    expected = torch.autograd.grad(torch.addmm(a, b, c), (a, b, c), weights)
    with bfloat16():
        found = torch.autograd.grad(in_full_precision(torch.addmm, a, b, c), (a, b, c), weights)
        plain = torch.autograd.grad(torch.addmm(a, b, c).float(), (a, b, c), weights)
    assert all(torch.equal(x, y) for x, y in zip(found, expected, strict=True))
    assert not torch.equal(plain[1], expected[1])


def test_gradients_by_finite_differences():
    a, b = (torch.rand(2, 3, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(lambda *x: in_full_precision(torch.bmm, *x), (a, b))
    assert torch.autograd.gradcheck(lambda x: in_full_precision(torch.bmm, x, b.detach()), a)
    assert torch.autograd.gradgradcheck(lambda *x: in_full_precision(torch.bmm, *x), (a, b))
    assert torch.autograd.gradgradcheck(lambda x: in_full_precision(torch.bmm, x, 2 * x), a)
    assert not in_full_precision(torch.bmm, a.detach(), b.detach()).requires_grad


def settings():
    backends = torch.backends
    return [x.fp32_precision for x in (backends, backends.mkldnn.matmul, backends.cuda.matmul)]


def rounded():
    """Whether products may be rounded: what the setting says, whatever this processor can do."""
    if not hasattr(torch.backends.mkldnn, "matmul"):
        return torch.get_float32_matmul_precision() != "highest"
    return not set(settings()[1:]) <= {"ieee", "none"}
