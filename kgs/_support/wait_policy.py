"""How OpenMP's threads wait, which torch reads when it is loaded."""

import os
import sys

_OWN = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")  # what a user may have set


def wait_passively() -> bool:
    """Let torch's waiting threads leave their core to others, by `OMP_WAIT_POLICY=PASSIVE`; call it before torch.

    Else they keep it busy, and while other programs run everything takes several times as long. The command `kgs` calls
    it. It changes the environment of this process and of those that it starts.

    Returns:
        Whether it had an effect: False where torch is loaded already, or the environment has a setting of its own.

    Examples:
        >>> import kgs
        >>> is_passive = kgs.wait_passively()  # and then: import torch
    """
    if "torch" in sys.modules or any(name in os.environ for name in _OWN):
        return False
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    return True
