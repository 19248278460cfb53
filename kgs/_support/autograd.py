"""What the autograd functions of kgs have in common."""

import torch


def refuse_second_derivative(name: str, hint: str = "") -> None:
    """Raise a RuntimeError in a backward pass with `create_graph`, as transforms of `torch.func` make it.

    Args:
        name: of what has no second derivative.
        hint: what to do instead.
    """
    if torch.is_grad_enabled():  # once_differentiable is silent where the incoming gradient is a constant
        reason = "there is no second derivative, nor a transform of torch.func"
        raise RuntimeError(f"{name}: expected backward without create_graph, {reason}{hint}")
