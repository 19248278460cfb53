"""What tests of stiff cases have in common."""

import functools

import torch
from factories import one_gaussian

one = functools.partial(one_gaussian, dtype=torch.float32)
