"""The backend of Triton kernels, for float32 on GPUs.

`activation`, `projection`, `compositing`, `blending`, `loss` and `optimizer` bring the kernels of a stage to torch,
which stand in the file of kernels beside it; the other files of kernels are parts of these. `launch` calls them,
`compiling` compiles them ahead, `verdict` keeps that they passed :func:`self_check`, and `entry_counts` tells
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

import functools
import logging
import os
from collections.abc import Callable

import torch

from kgs._support.errors import cause_of, warn
from kgs.backends.base import (
    ActivationStage,
    Backend,
    BlendingStage,
    CompositingCall,
    Compositor,
    LossStage,
    OptimizerStages,
    ProjectionStage,
)

_log = logging.getLogger("kgs")


class GpuBackend(Backend):
    """Kernels for pinhole cameras, tiles of 8 x 8 pixels, loss and optimizer; other cameras go to torch, inside."""

    name = "triton"
    devices = ("cuda", "xpu")  # "cuda" are AMD's, too
    dtypes = (torch.float32,)
    tile_size = 8  # a constant of the kernels
    package = ("triton", "torch brings it on Linux; on Windows: pip install triton-windows")
    has_loss = True
    has_optimizer = True

    def runs_on(self, device: torch.device) -> bool:
        """On GPUs, and on CPUs in Triton's interpreter."""
        return (device.type == "cpu" and _is_interpreted()) or super().runs_on(device)

    def is_trusted(self, device: torch.device) -> bool:
        """Whether the kernels pass :func:`self_check`, once for each GPU; never in the interpreter."""
        if device.type == "cpu" or _is_interpreted():
            return False
        index = torch.get_device_module(device).current_device() if device.index is None else device.index
        try:
            return self_check(torch.device(device.type, index))
        except torch.OutOfMemoryError:  # says nothing about the kernels
            return False

    def compile_ahead(self, run: Callable[[torch.device], object], device: torch.device) -> None:
        """See `Backend.compile_ahead`."""
        if _is_interpreted():
            return
        from .compiling import compile_together, needed_launches

        try:
            compile_together(needed_launches(lambda: run(torch.device("cpu"))), device)
        except Exception:  # whatever is wrong is met again when it is launched
            _log.debug("kernels are compiled one after another", exc_info=True)

    def covers_compositing(self, call: CompositingCall) -> bool:
        """Only its own tile size, no `chunk_size`, and of many features no `absgrad`: blocks would be added up."""
        one_block = not call.options.absgrad or call.features.shape[1] <= 4
        return call.options.tile_size in (None, self.tile_size) and call.chunk_size is None and one_block

    @property
    def activate(self) -> ActivationStage:
        """See `Backend.activate`."""
        from .activation import activate

        return activate

    @property
    def project(self) -> ProjectionStage:
        """See `Backend.project`."""
        from .projection import project

        return project

    @property
    def compositor(self) -> type[Compositor]:
        """See `Backend.compositor`."""
        from .compositing import GpuCompositor

        return GpuCompositor

    @property
    def blend(self) -> BlendingStage:
        """See `Backend.blend`."""
        from .blending import blend

        return blend

    @property
    def loss(self) -> LossStage:
        """See `Backend.loss`."""
        from .loss import GpuLoss

        return GpuLoss()

    @property
    def optimizer(self) -> OptimizerStages:
        """See `Backend.optimizer`."""
        from .optimizer import GpuOptimizer

        return GpuOptimizer()


def _is_interpreted() -> bool:
    return os.environ.get("TRITON_INTERPRET") == "1"


@functools.cache
def self_check(device: torch.device) -> bool:
    """Whether a small scene comes out as in torch on a device; a warning says what is wrong.

    The first time on a machine the kernels are compiled, which takes seconds, and the log says how far that is. That
    they have passed is kept on disk, see `.verdict`.

    Raises:
        torch.OutOfMemoryError: there is no room for it now; what is raised is not remembered.
    """
    from kgs.backends.agreement import BOUND, FITS, disagreement

    from . import verdict

    if verdict.is_kept(device):
        return True
    try:  # twice: from their second call on kernels are launched in another way, see `.launch`
        difference = max(disagreement(GpuBackend(), device, FITS) for _ in range(2))
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # a compiler that does not know the card, a driver: kgs can do without
        reason = cause_of(error)
    else:
        if difference <= BOUND:
            verdict.keep(device)
            return True
        reason = f"they differ from torch by {difference:.1e}, more than {BOUND:g}"
    warn(f"kgs: Triton's kernels are not used on {device}, torch is: {reason}")
    return False
