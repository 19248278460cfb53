"""Trainers for tests of fits, and what two of them have in common."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from kgs.datasets.scene import Scene
from kgs.fit.config import FitConfig, Settings
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.init_points import InitialPoints


def settled(config: FitConfig, **changes: Any) -> Settings:
    """The settings of a fit with these changes; what is open has a number that no rule knows."""
    config = replace(config, **changes)
    numbers = {"steps": 800, "drop": 0.25, "sh_degree": 0, "coarse": 0.0}
    decay = config.recipe.opacity_decay
    entries = {name: number for name, number in numbers.items() if getattr(config, name) is None}
    return Settings.of(config, opacity_decay=0.99 if decay is None else decay, **entries)


def begun(scene: Scene, points: InitialPoints, config: FitConfig, **changes: Any) -> Trainer:
    """A trainer of a configuration with these changes, before its first step."""
    return Trainer(scene, make_plan(scene, replace(config, **changes), points), points)


def fitted(scene: Scene, points: InitialPoints, config: FitConfig, **changes: Any) -> Trainer:
    """The same after its last step."""
    trainer = begun(scene, points, config, **changes)
    trainer.fit()
    return trainer


def stop_at(step: int) -> Any:
    """A callback that ends a fit after this step."""
    return lambda trainer, _: trainer.step == step


def assert_same_bits(one: Trainer, other: Trainer) -> None:
    """Of all parameters of the Gaussians."""
    expected = dict(other.model.named_parameters())
    for name, value in one.model.named_parameters():
        assert torch.equal(value, expected[name]), name
