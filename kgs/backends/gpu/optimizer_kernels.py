"""What a fit does with gradients after the backward pass, in place, an element for each lane.

`update_by_adam` follows `torch.optim.Adam`, `add_norms` and `decay_logits` follow `kgs.densify`.
"""

import triton
import triton.language as tl

from .footprint_kernels import is_finite


@triton.jit
def _update(
    parameter, gradient, exp_avg, exp_avg_sq, n, block, step_size, root, eps,
    BETA1: tl.constexpr, BETA2: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One block of one tensor of n elements."""
    i = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    g = tl.load(gradient + i, mask=inside, other=0.0)
    first = tl.load(exp_avg + i, mask=inside, other=0.0)
    second = tl.load(exp_avg_sq + i, mask=inside, other=0.0)
    first += (g - first) * (1.0 - BETA1)
    second = second * BETA2 + g * g * (1.0 - BETA2)
    value = tl.load(parameter + i, mask=inside, other=0.0)
    tl.store(parameter + i, value - step_size * first / (tl.sqrt(second) / root + eps), mask=inside)
    tl.store(exp_avg + i, first, mask=inside)
    tl.store(exp_avg_sq + i, second, mask=inside)


@triton.jit(do_not_specialize=["n0", "n1", "n2", "n3", "n4", "n5"])
def update_by_adam(
    p0, g0, a0, s0, n0, size0, root0, p1, g1, a1, s1, n1, size1, root1, p2, g2, a2, s2, n2, size2, root2,
    p3, g3, a3, s3, n3, size3, root3, p4, g4, a4, s4, n4, size4, root4, p5, g5, a5, s5, n5, size5, root5, eps,
    BETA1: tl.constexpr, BETA2: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A step of Adam for six tensors, whose blocks follow one another.

    Of each: the parameter, its gradient, the moving averages of gradient and square, the number of elements, the
    learning rate over the correction of the first average, and the root of the correction of the second.
    """
    block = tl.program_id(0)
    end0 = tl.cdiv(n0, BLOCK)
    end1 = end0 + tl.cdiv(n1, BLOCK)
    end2 = end1 + tl.cdiv(n2, BLOCK)
    end3 = end2 + tl.cdiv(n3, BLOCK)
    end4 = end3 + tl.cdiv(n4, BLOCK)
    if block < end0:
        _update(p0, g0, a0, s0, n0, block, size0, root0, eps, BETA1, BETA2, BLOCK)
    elif block < end1:
        _update(p1, g1, a1, s1, n1, block - end0, size1, root1, eps, BETA1, BETA2, BLOCK)
    elif block < end2:
        _update(p2, g2, a2, s2, n2, block - end1, size2, root2, eps, BETA1, BETA2, BLOCK)
    elif block < end3:
        _update(p3, g3, a3, s3, n3, block - end2, size3, root3, eps, BETA1, BETA2, BLOCK)
    elif block < end4:
        _update(p4, g4, a4, s4, n4, block - end3, size4, root4, eps, BETA1, BETA2, BLOCK)
    else:
        _update(p5, g5, a5, s5, n5, block - end4, size5, root5, eps, BETA1, BETA2, BLOCK)


@triton.jit(do_not_specialize=["m"])
def add_norms(sums, counts, ids, gradient, m, scale_x, scale_y, BLOCK: tl.constexpr):
    """Add the norm of each of m gradients (m, 2), scaled, to its Gaussian's sum, and 1 to its count."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < m
    x = tl.abs(tl.load(gradient + 2 * i, mask=inside, other=0.0) * scale_x)
    y = tl.abs(tl.load(gradient + 2 * i + 1, mask=inside, other=0.0) * scale_y)
    larger = tl.maximum(x, y)
    usual = (larger > 0.0) & is_finite(x) & is_finite(y)
    ratio = tl.minimum(x, y) / tl.where(usual, larger, 1.0)
    norm = tl.where(usual, larger * tl.sqrt(1.0 + ratio * ratio), x + y)  # no square overflows or vanishes
    row = tl.load(ids + i, mask=inside, other=0)
    tl.store(sums + row, tl.load(sums + row, mask=inside, other=0.0) + norm, mask=inside)
    tl.store(counts + row, tl.load(counts + row, mask=inside, other=0) + 1, mask=inside)


@triton.jit(do_not_specialize=["n"])
def decay_logits(logits, n, log_factor, log_rest, BLOCK: tl.constexpr):
    """The logits of f s(x) for those of s(x): log f - log(e^-x + 1 - f), from log f and log(1 - f)."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    x = tl.load(logits + i, mask=inside, other=0.0)
    larger = tl.maximum(-x, log_rest)
    part = tl.exp(-tl.abs(-x - log_rest))
    whole = 1.0 + part
    log1p = tl.where(whole == 1.0, part, tl.log(whole) * (part / (whole - 1.0)))  # the quotient undoes the rounding
    tl.store(logits + i, log_factor - (larger + log1p), mask=inside)
