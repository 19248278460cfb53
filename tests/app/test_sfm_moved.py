"""Two groups of photos that only one small, flat thing joins."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pycolmap")

from kgs.app.sfm.moved import moved_photos

SIZE = np.array([640.0, 480.0])


def reconstruction(groups, *, share=0.2, thickness=0.0, joining=150, own=200):
    """Points as a solver gives them: of each group, and of a thing that all see in the middle of their photos.

    Args:
        groups: how many photos are in each.
        share: of the sides of a photo that the thing takes.
        thickness: of the thing, over its extent.
        joining: how many points it has.
        own: how many points each group sees beside it.
    """
    random = np.random.default_rng(0)
    images = {
        i: SimpleNamespace(name=f"{i}.png", camera=SimpleNamespace(width=640, height=480), points2D=[])
        for i in range(sum(groups))
    }
    points = {}

    def see(ids, xyz, pixel):
        elements = []
        for i in ids:
            elements.append(SimpleNamespace(image_id=i, point2D_idx=len(images[i].points2D)))
            images[i].points2D.append(SimpleNamespace(xy=pixel))
        points[len(points)] = SimpleNamespace(xyz=xyz, track=SimpleNamespace(elements=elements))

    for _ in range(joining):
        place = random.uniform(-0.5, 0.5, 3) * (1.0, 1.0, thickness)
        see([*images], place, (0.5 + share * place[:2]) * SIZE)
    first = 0
    for count in groups:
        for _ in range(own):
            see(range(first, first + count), random.uniform(-2, 2, 3), random.uniform(0, 1, 2) * SIZE)
        first += count
    return SimpleNamespace(
        images=images, points3D=points, reg_image_ids=lambda: [*images], num_points3D=lambda: len(points)
    )


def test_the_smaller_group_is_named():
    assert moved_photos(reconstruction((4, 3))) == ["4.png", "5.png", "6.png"]
    assert moved_photos(reconstruction((2, 5))) == ["0.png", "1.png"]


@pytest.mark.parametrize(
    ("groups", "thing"),
    {
        "one scene": ((7,), {}),
        "a thing with depth": ((4, 3), {"thickness": 0.5}),
        "a floor or a wall": ((4, 3), {"share": 1.0}),
        "a photo alone": ((6, 1), {}),
        "groups that show little else": ((4, 3), {"own": 40}),
        "no points": ((4,), {"own": 0, "joining": 0}),
    }.values(),
)
def test_other_photos_are_of_one_scene(groups, thing):
    assert moved_photos(reconstruction(groups, **thing)) == []
