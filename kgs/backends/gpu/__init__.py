"""The backend of Triton kernels, for float32 on GPUs.

`activation`, `projection`, `compositing`, `blending`, `loss` and `optimizer` bring the kernels of a stage to torch,
which stand in the file of kernels beside it; the other files of kernels are parts of these. `launch` calls them,
`compiling` compiles them ahead, `trust` has them checked on a card before "auto" takes them, and `entry_counts` tells
compositing what projection has counted. Torch defines what is right; a kernel gives the same within the rounding of
float32, and its formulas are explained in the torch code that it follows. `import kgs` does not import triton: a stage
is imported when it is first used.

With TRITON_INTERPRET=1 in the environment the kernels run on a CPU, slowly: so they are tested without a GPU.

Rules:

1. A program writes what no other program writes, and nothing is added atomically: the same bits in each run.
2. A number is read from the device only where the size of a tensor follows from it, and with it whether torch must
   do the call: reading waits for all work. A render of one camera reads once.
3. What a kernel is called with is checked before; it clamps nothing but the indices of masked lanes.
4. Integers are named in `do_not_specialize`: Triton would compile again for other numbers of Gaussians and cameras, and
   for images of another size.
5. Constants of a module stand to the right of operators; block shapes are powers of two; a loop whose end depends on
   data is a `while` on a scalar.
"""

import os

import torch

from kgs.backends.table import Backend, Lazy


class _Triton(Backend):
    def runs_on(self, device: torch.device) -> bool:
        """Whether it is a GPU, or a CPU in Triton's interpreter."""
        return super().runs_on(device) or (device.type == "cpu" and os.environ.get("TRITON_INTERPRET") == "1")


# for pinhole cameras: others go to torch, inside the call
TRITON = _Triton(
    "triton",
    devices=("cuda", "xpu"),  # "cuda" are AMD's, too
    dtypes=(torch.float32,),
    package=("triton", "torch brings it on Linux; on Windows: pip install triton-windows"),
    is_trusted=Lazy("kgs.backends.gpu.trust:is_trusted"),
    compile_ahead=Lazy("kgs.backends.gpu.compiling:compile_ahead"),
    tile_size=8,  # a constant of the kernels
    max_absgrad_features=4,  # a block: sums of absolute values of several would be added up
    activate=Lazy("kgs.backends.gpu.activation:activate"),
    project=Lazy("kgs.backends.gpu.projection:project"),
    compositor=Lazy("kgs.backends.gpu.compositing:GpuCompositor"),
    blend=Lazy("kgs.backends.gpu.blending:blend"),
    loss=Lazy("kgs.backends.gpu.loss:loss"),
    loss_gradient=Lazy("kgs.backends.gpu.loss:loss_gradient"),
    adam_step=Lazy("kgs.backends.gpu.optimizer:adam_step"),
    add_gradient_norms=Lazy("kgs.backends.gpu.optimizer:add_gradient_norms"),
    decay_opacity=Lazy("kgs.backends.gpu.optimizer:decay_opacity"),
)
