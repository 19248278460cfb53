"""Skips the test files whose packages of an extra are missing: a machine with a card may have little else."""

from pathlib import Path
from typing import Any

import pytest

OPTIONAL = ("PIL", "cv2", "distributed", "matplotlib", "numba", "pandas", "pycolmap", "scipy", "trimesh", "tyro")


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    """Pytest's hook: see `SkippingModule`."""
    module: pytest.Module = SkippingModule.from_parent(parent, path=module_path)
    return module


class SkippingModule(pytest.Module):
    """A test file that is skipped, with the reason, where a package of `OPTIONAL` that it imports is missing."""

    def _getobj(self) -> Any:
        try:
            return super()._getobj()
        except self.CollectError as error:
            missing = error.__cause__.name if isinstance(error.__cause__, ModuleNotFoundError) else None
            if missing is not None and missing.partition(".")[0] in OPTIONAL:
                pytest.skip(f"{missing} is not installed", allow_module_level=True)
            raise
