"""What a type checker must find in kgs: `mypy --strict` of this file, from outside the clone, is silent."""

from typing import assert_type

import kgs
from kgs.fit import FitConfig

drop = kgs.DropGaussian(0.2)
assert_type(drop, kgs.DropGaussian)
assert_type(FitConfig().seed, int)
drop.progress = "a"  # type: ignore[assignment]
