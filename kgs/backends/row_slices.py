"""Row slices: consecutive rows of tiles whose lists fit into `max_bytes` together."""

import torch

from kgs._support.errors import ArgumentError

MAX_BYTES = 2**30  # where the user gives none


def default_max_bytes(wanted: int, device: torch.device) -> int:
    """The bound where the user gives none, for lists that would take so many bytes as a whole.

    `MAX_BYTES`, and on a GPU half of what the card and torch's allocator have free, which is asked only where more is
    wanted.
    """
    module = torch.get_device_module(device)
    if wanted <= MAX_BYTES or not hasattr(module, "mem_get_info"):
        return MAX_BYTES
    free: int = module.mem_get_info(device)[0]
    free += module.memory_reserved(device) - module.memory_allocated(device)
    return max(MAX_BYTES, free // 2)


def row_slices(row_bytes: list[int], max_bytes: int) -> list[tuple[int, int]]:
    """The first and last (exclusive) row of each slice, for rows of tiles that need so many bytes each.

    Raises:
        ValueError: one row needs more than `max_bytes`.
    """
    slices = []
    begin = 0
    total = 0
    for row, size in enumerate(row_bytes):
        check_fits(size, max_bytes)
        if total + size > max_bytes:
            slices.append((begin, row))
            begin = row
            total = 0
        total += size
    return [*slices, (begin, len(row_bytes))]


def check_fits(row_bytes: int, max_bytes: int) -> None:
    """Raise a ValueError where one row of tiles needs more than `max_bytes`."""
    if row_bytes > max_bytes:
        advice = "raise max_bytes, or render fewer or smaller Gaussians"
        raise ArgumentError("max_bytes", f"at least {row_bytes}, for a row of tiles", max_bytes, advice=advice)
