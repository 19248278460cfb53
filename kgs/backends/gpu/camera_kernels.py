"""What kernels read of a pinhole camera, as one row of numbers; and the gradients of cameras.

A row, `WIDTH` numbers: world to camera (3, 4), intrinsics (2, 3), limits of x / z, then of y / z, the centre (3,),
whether the kernels cover it, the inverse of the pose's 3x3 block, and the `visibility_cutoff` of
`kgs.geometry.projection`, which is the same for all cameras.
"""

import triton
import triton.language as tl

from .footprint_kernels import is_finite

WIDTH = 36
COVERED = 25  # column: 1 for finite numbers, focal lengths other than 0, and an affine, invertible pose; else 0

CUTOFF = 35  # column: how many standard deviations of a footprint count as visible

_WIDTH: tl.constexpr = tl.constexpr(WIDTH)
_COVERED: tl.constexpr = tl.constexpr(COVERED)
_CUTOFF: tl.constexpr = tl.constexpr(CUTOFF)
_WIDER: tl.constexpr = tl.constexpr(1e-3)  # see `kgs.geometry.projection.cut_squared`


@triton.jit
def _cofactor(pose, i, j):
    """Cofactor of the 3x3 block of a pose."""
    r0, r1 = pose + (i + 1) % 3 * 4, pose + (i + 2) % 3 * 4
    c0, c1 = (j + 1) % 3, (j + 2) % 3
    return tl.load(r0 + c0) * tl.load(r1 + c1) - tl.load(r0 + c1) * tl.load(r1 + c0)


@triton.jit
def _store_limits(out, focal, centre, low, high, margin):
    """The limits of a tangent, see `kgs.geometry.lenses.tangent_limits`."""
    first = -(centre - low + margin) / focal
    last = (high - centre + margin) / focal
    tl.store(out, tl.minimum(first, last))
    tl.store(out + 1, tl.maximum(first, last))


@triton.jit
def _store_cutoff(out, largest, blocks, threshold, BLOCK: tl.constexpr):
    """The number of standard deviations that count as visible, by the largest opacities of blocks of Gaussians."""
    i = tl.arange(0, BLOCK)
    peak = tl.zeros((BLOCK,), tl.float32) + 2.0
    first = 0
    while first < blocks:
        peak = tl.maximum(peak, tl.load(largest + first + i, mask=first + i < blocks, other=0.0))
        first += BLOCK
    cut = 2.0 * tl.log(tl.max(peak, 0) / threshold) + _WIDER
    cut = tl.where(threshold > 0.0, cut, float("inf"))
    tl.store(out, tl.sqrt(tl.maximum(cut, 9.0)))


@triton.jit(do_not_specialize=["blocks"])
def describe_cameras(
    intrinsics, extrinsics, left, top, right, bottom, margin_x, margin_y, largest, blocks, threshold, rows,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill the row of a camera from its matrices `(4, 4)`; the last rows of the intrinsics have been checked."""
    c = tl.program_id(0)
    matrix, pose, out = intrinsics + c * 16, extrinsics + c * 16, rows + c * _WIDTH
    i = tl.arange(0, 16)
    k, e = tl.load(matrix + i), tl.load(pose + i)
    unit = tl.where(i % 5 == 0, 1.0, 0.0)
    covered = is_finite(k) & is_finite(e) & ((e == unit) | (i < 12))
    covered &= (k != 0.0) | ((i != 0) & (i != 5))
    covered = tl.min(covered.to(tl.int32), 0)
    for j in tl.static_range(12):
        tl.store(out + j, tl.load(pose + j))
    for j in tl.static_range(3):
        tl.store(out + 12 + j, tl.load(matrix + j))
        tl.store(out + 15 + j, tl.load(matrix + 4 + j))
    _store_limits(out + 18, tl.load(matrix), tl.load(matrix + 2), left, right, margin_x)
    _store_limits(out + 20, tl.load(matrix + 5), tl.load(matrix + 6), top, bottom, margin_y)
    det = tl.load(pose) * _cofactor(pose, 0, 0) + tl.load(pose + 1) * _cofactor(pose, 0, 1)
    det += tl.load(pose + 2) * _cofactor(pose, 0, 2)
    covered = tl.where((det != 0.0) & is_finite(det), covered, 0)  # torch says that it has no inverse
    for j in tl.static_range(3):
        moved = tl.load(pose + 3) * 0.0
        for m in tl.static_range(3):
            inverse = _cofactor(pose, m, j) / det
            tl.store(out + 26 + 3 * j + m, inverse)
            moved -= inverse * tl.load(pose + 4 * m + 3)
        tl.store(out + 22 + j, moved)
    tl.store(out + _COVERED, covered.to(tl.float32))
    _store_cutoff(out + _CUTOFF, largest, blocks, threshold, BLOCK)
