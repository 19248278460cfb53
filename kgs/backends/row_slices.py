"""Row slices: consecutive rows of tiles whose lists fit into `max_bytes` together."""

from kgs._support.errors import ArgumentError


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
        got = f"expected at least that, got {max_bytes} for it"
        ways = "raise max_bytes, or render fewer or smaller Gaussians"
        raise ArgumentError(f"max_bytes: one row of tiles needs {row_bytes} bytes, {got}; {ways}")
