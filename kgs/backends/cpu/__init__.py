"""The backend of numba kernels, for float32 on a CPU.

Each `X_kernels.py` has the kernels of a stage, NumPy arrays in and out, and `X.py` beside it brings them to torch.
Torch defines what is right; a kernel gives the same within the rounding of float32, and its formulas are
explained in the torch code that it follows. `import kgs` does not import numba: a stage is imported when it is first
used.

Rules that keep the kernels fast. Breaking any of them cost a measured factor of 1.5 to 3, without any warning:

1. Pixels of a tile are the lanes of SIMD: kernels that loop over pixels of tiles use the `Lanes` of
   `kgs._support.compiled`, and what runs from layer to layer stays in them. Other loops, over columns, read and write
   arrays at constant distances; otherwise LLVM finds dependences and the loop stays scalar.
2. An index of an array must be provably >= 0, because indices wrap: a loop that counts down masks its index.
3. `fastmath` lets sums be reassociated; NaN and infinity keep their meaning.
4. Literals are float64 in numba: every constant is an `np.float32`.
5. Reads may miss the caches, writes may not: gathers are loops of their own, and sums by Gaussian are kept for a band
   of neighbouring tiles.
6. The number of features is a constant of the compiled kernel: the length of a tuple.
7. What a step needs comes from `kgs._support.memory`, which uses memory again and begins at a cache line.
8. Ranges and bands do not depend on the number of threads, and nothing is summed by two threads: same bits on any
   number of them.
"""

import torch

from kgs._support.extras import installing
from kgs.backends.table import Backend, Lazy

# for pinhole cameras: others go to torch, inside the call
NUMBA = Backend(
    "numba",
    devices=("cpu",),
    dtypes=(torch.float32,),
    package=("numba", f"run {installing('fast')}"),
    tile_size=8,  # a constant of the kernels
    max_width=2**18 - 8,  # columns of tiles, and how many, are numbers of 15 bits
    has_torch_on_one_thread=True,
    max_absgrad_features=8,  # a block: sums of absolute values of several would be added up
    project=Lazy("kgs.backends.cpu.projection:project"),
    compositor=Lazy("kgs.backends.cpu.compositing:CpuCompositor"),
    loss=Lazy("kgs.backends.cpu.loss:loss"),
    loss_gradient=Lazy("kgs.backends.cpu.loss:loss_gradient"),
    local_moments=Lazy("kgs.backends.cpu.loss:local_moments"),
)
