"""The groups of the study of sparse views: its methods, which settings are the main ones, and paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .published import PAPER
from .statistics import Group, by_seed, paired

__all__ = [
    "EQUAL_MEAN_RATE",
    "FAMILIES",
    "FIXED",
    "MAIN",
    "OFF",
    "Groups",
    "all_settings",
    "main_settings",
    "measured",
    "ordered",
    "over",
]

Groups = Mapping[Group, Mapping[int, Mapping[str, Any]]]

OFF, FIXED = "off", "fixed 0.1"
MAIN = (OFF, PAPER, FIXED)
FAMILIES = {
    "Rates and schedules": (
        *("progressive 0.1", "progressive 0.3", "fixed 0.05"),
        *("fixed 0.1", "fixed 0.15", "fixed 0.2", "fixed 0.3"),
    ),
    "Selected Gaussians dropped instead of random ones": ("high gradient", "low gradient", "near", "far"),
    "An L1 penalty on opacities instead of dropping": (
        *("L1 gradient 0.001", "L1 gradient 0.01"),
        *("L1 distance 0.001", "L1 distance 0.01"),
    ),
}
EQUAL_MEAN_RATE = {"progressive 0.1": "fixed 0.05", "progressive 0.2": "fixed 0.1", "progressive 0.3": "fixed 0.15"}
_METHODS = tuple(dict.fromkeys((*MAIN, *(name for family in FAMILIES.values() for name in family))))


def ordered(names: Iterable[str], order: Sequence[str] = _METHODS) -> list[str]:
    """Each name once, known ones first and in their order."""
    return sorted(dict.fromkeys(names), key=lambda name: order.index(name) if name in order else len(order))


def all_settings(groups: Groups) -> list[Group]:
    """Scene, views and start of all groups, under the method "off", whether or not that has cells; scene by scene."""
    scenes = [group.scene for group in groups]
    settings = dict.fromkeys(group._replace(method=OFF) for group in groups)
    return sorted(settings, key=lambda s: (scenes.index(s.scene), s.views, s.start != "dense"))


def main_settings(groups: Groups) -> list[Group]:
    """Each scene's main protocol: its fewest views, dense first points. Scenes without these are left out."""
    settings: dict[str, Group] = {}
    for setting in all_settings(groups):
        if setting.start == "dense":
            settings.setdefault(setting.scene, setting)
    return list(settings.values())


def over(groups: Groups, group: Group, measure: str = "test.psnr", **base: str) -> list[float]:
    """A group's paired differences over the group that differs from it in the fields given."""
    other = group._replace(**base)  # type: ignore[arg-type]  # the method or the start, both str
    return paired(measured(groups, group, measure), measured(groups, other, measure))


def measured(groups: Groups, group: Group, measure: str = "test.psnr") -> dict[int, float]:
    """A measure of a group by seed; empty where the study has no such group."""
    return by_seed(groups.get(group, {}), measure)
