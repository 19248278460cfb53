"""`kgs check`: what is installed, and whether it works."""


def check(*, device: str | None = None) -> int:
    """Show versions, devices and backends, whether each is right, how fast it is, and which one is taken.

    For example:
      kgs check
      kgs check --device cuda:1

    Run it first, and put what it prints into a report of a fault. It takes 20 seconds, the first time a minute:
    kernels are compiled, and kept. The exit code is 1 where something is wrong.

    Args:
        device: what to check: cpu, cuda, cuda:1, xpu, ... ; not given: the CPU and all GPUs.
    """
    from kgs.bench.check import check

    return check(device=device)
