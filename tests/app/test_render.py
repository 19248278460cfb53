"""`kgs render`: pictures of a splat, and no photo of the user's lost."""

import cv2
import numpy as np
import pytest
import torch
from factories import random_model
from tiny_scenes import write_llff

import kgs
from kgs import GaussianRenderer, save_ply
from kgs._support.errors import DataError
from kgs.app.cli.page import page
from kgs.app.cli.render import render
from kgs.app.page import pictures
from kgs.datasets import load_scene
from kgs.datasets.image_file import ImageFile


@pytest.fixture(scope="module")
def splat(tmp_path_factory):
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, generator=generator) + torch.tensor([-0.5, -0.5, 4.0])
    save_ply(path, kgs.GaussianModel.from_points(points, torch.rand(50, 3, generator=generator), 0))
    return path


@pytest.fixture
def llff(tmp_path):
    """An LLFF folder with ten PNGs."""
    root = tmp_path / "llff"
    root.mkdir()
    write_llff(root, 10, (40, 30))
    return root


def test_pictures_and_pages_are_shrunk_and_have_a_background(splat, llff, tmp_path):
    for background, minimum in (("black", 0.0), ("white", 1.0)):
        out = tmp_path / background
        render(splat, cameras=llff, out=out, downscale=2.0, background=background)
        pictures = [cv2.imread(str(path)) for path in sorted(out.glob("*.png"))]
        assert {picture.shape for picture in pictures} == {(15, 20, 3)}
        assert {int(picture[0, 0].max()) for picture in pictures} == {round(255 * minimum)}  # no Gaussian is there
    page(splat, cameras=llff, out=tmp_path / "page.html", downscale=2.0, background="white")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "20 × 15 pixels" in text
    assert '"background":[1.0,1.0,1.0]' in text
    with pytest.raises(ValueError, match="downscale: expected photos of at least 11 pixels a side, got 8x6"):
        page(splat, cameras=llff, out=tmp_path / "page.html", downscale=5.0)
    with pytest.raises(ValueError, match="size: expected either a size or a downscale factor, got both"):
        page(splat, cameras=llff, out=tmp_path / "page.html", size=32, downscale=5.0)
    page(splat, cameras=llff, out=tmp_path / "page.html", size=32)
    assert "32 × 24 pixels" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_splat_is_rendered_as_its_tag_says(llff, tmp_path, antialiased):
    generator = torch.Generator().manual_seed(0)
    model = random_model(300, 0)  # small Gaussians: the low-pass filter makes most of the footprint
    with torch.no_grad():
        model.means.copy_(2.0 * torch.rand(300, 3, generator=generator) + torch.tensor([-1.0, -1.0, 3.0]))
        model.log_scales.fill_(-4.0)
    model.antialiased = antialiased
    save_ply(tmp_path / "splat.ply", model)
    render(tmp_path / "splat.ply", cameras=llff, out=tmp_path / "out")
    scene = load_scene(llff, train_views=None, hold_out=0)
    images = []
    with torch.no_grad():
        model.means.sub_(scene.offset)
        for smoothed in (False, True):
            image = GaussianRenderer(antialiased=smoothed)(model(), scene.train.camera(0)).image[0]
            images.append(255.0 * image.clamp(0.0, 1.0).permute(1, 2, 0).flip(2).numpy())
    picture = cv2.imread(str(tmp_path / "out" / "0.png"))
    assert np.abs(images[True] - images[False]).max() > 50
    np.testing.assert_allclose(picture, images[antialiased], rtol=0, atol=1.0)


@pytest.mark.parametrize("shift", [(0.0, 0.0, -100.0), (1000.0, 0.0, 0.0)])
def test_a_splat_that_no_camera_sees_is_refused_before_anything_is_written(splat, llff, tmp_path, shift):
    model, path = kgs.load_ply(splat), tmp_path / "moved.ply"
    with torch.no_grad():
        model.means.add_(torch.tensor(shift))
    save_ply(path, model)
    for call, out in ((render, "renders"), (page, "page.html")):
        with pytest.raises(DataError, match=r"moved\.ply: Gaussians: expected some that a camera of .* got none of 50"):
            call(path, cameras=llff, out=tmp_path / out)
        assert not (tmp_path / out).exists()


def test_cameras_that_see_nothing_are_named(splat, llff, tmp_path, capsys):
    render(splat, cameras=llff, out=tmp_path / "all")
    assert "see no Gaussian" not in capsys.readouterr().out
    poses = np.load(llff / "poses_bounds.npy")
    for row in (poses[3], poses[7]):
        row[:15].reshape(3, 5)[:, 1:3] *= -1.0  # turned about
    np.save(llff / "poses_bounds.npy", poses)
    render(splat, cameras=llff, out=tmp_path / "some")
    assert f"these cameras see no Gaussian of {splat}: 3.png, 7.png" in capsys.readouterr().out
    assert not cv2.imread(str(tmp_path / "some" / "3.png")).any()


def test_a_page_of_any_splat(splat, llff, tmp_path, capsys, monkeypatch):
    out, decoded, plain = tmp_path / "page.html", [], ImageFile.read
    monkeypatch.setattr(ImageFile, "read", lambda file: decoded.append(file.path.name) or plain(file))
    monkeypatch.setattr(pictures, "MAX_THUMBNAILS", 4)
    page(splat, cameras=llff, out=out)
    text = out.read_text(encoding="utf-8")
    assert len(decoded) == 6 + 4  # of ten, and those of the strip: there may be hundreds
    assert all(f'alt="photo {name}"' in text for name in decoded[:6])
    assert text.count('<img alt="" src="data:image/jpeg') == 4
    assert "40 × 30 pixels" in text
    assert "If the splat was fitted to these photos, their PSNR says little about other views." in text
    assert f"open {out} in a browser" in capsys.readouterr().out
    page(splat, cameras=llff, out=out)  # its own file is written again
