"""HEIC photos: upright, with what they say of the lens; without their extra, with what to do."""

import base64
import zlib

import numpy as np
import pytest

from kgs._support.errors import DataError
from kgs._support.progress import silent
from kgs.app.sfm.find import find_photos, notes_on
from kgs.app.sfm.read import open_photos, read_photos
from kgs.datasets import folders
from kgs.datasets.image_file import ImageFile, is_heic

pi_heif = pytest.importorskip("pi_heif")

P3_TO_SRGB = np.array([[1.2249402, -0.2249402, 0.0], [-0.0420569, 1.0420569, 0.0], [-0.0196376, -0.0786361, 1.0982736]])
BT2020_TO_SRGB = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
# 64x48 pixels of red 4 x, green 5 y and blue 255 - 2 x, stored lying, to be turned by 90 degrees; 26 mm as on film.
PHOTO = zlib.decompress(
    base64.b85decode(
        b"c-muNV30{GsVvAy%}izhg51nBLl8SRGck>Uf$>CcYDppk1Sn>t<P<^K3<a6VB@Af5Br_);Y>0~k0}}%yh{gB@LIc4ZpcoJ^b-+cOfY>54GcOIy1I"
        b"da4IjLY}Ks6a<$%YI_f{Y*~t`(VJ<$ML1CAkbxm5l6}1w{ow_Or}_<a{7q2Gr}!$P5yi09GXTf#J{JA3qov_?Z)cIwTwzc^Loy2Pt3%sbB^nxm`>"
        b"Si9ks$Cq_mznFR`stkYgSS+;WrM}~m{P>2~sFeoMgm9x1p9xOi43A98wIX|Z;FFB_ID9X#g)&LX|$t*5Ng?iTkiZzmR5(}VgP*4~^X>cI?|Ns93G"
        b"%y4TGAlAcg3KHo96*XQvnam==pF{i%z|84q%bltvNbX>v$nJWIZ~NLscBFNzT}kRWN<Wq%zl=ek_d{g85)f1IUm^Z&7S8cP_p5e&PR_=J!h?Up6^"
        b"eY$XRS*9T?PB^+=4Ngt@ynnqxMjfP3!NMQzhxgv6fgp1M0WXbaojwpUfrk|B~STSe7YvKM8aWV-pdNuZ-3g{`6|v!eQp#evhGZ*4MNpXB%Z`QIa-"
        b"PKUW4D&4nK`@n6^nH%JbV&7=57u@LG)LeA7bj!OY@gSaSUbTzmmc4mX0dyN1ByN3u8MJ^r4hAMhAyDvxf|!A!J(Gb28cu2uk1t_`%1S{z3;+nhqB"
        b"{"
    )
)


@pytest.fixture
def folder(tmp_path):
    for i, name in enumerate(("IMG_2.HEIC", "IMG_1.heic", "IMG_3.jpg")):  # phones send HEIC as JPEG, too
        (tmp_path / name).write_bytes(PHOTO + bytes(i))  # three files: equal ones are one photo
    return tmp_path


def test_pixels_are_upright_and_the_lens_is_known(folder):
    assert is_heic(PHOTO)
    paths = find_photos(folder)
    assert [path.name for path in paths] == ["IMG_1.heic", "IMG_2.HEIC", "IMG_3.jpg"]
    y, x = np.mgrid[:48, :64]
    stored = np.stack([4 * x, 5 * y, 255 - 2 * x], axis=-1).astype(float)
    for photo in read_photos(open_photos(paths), silent):
        assert photo.size == (48, 64)
        assert np.abs(photo.pixels - np.rot90(stored, 3)).max() <= 8  # its compression has losses
        assert photo.exif.orientation == 1
        assert photo.exif.focal_35mm == 26
        assert photo.focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(48, 64))


def test_one_that_exif_alone_turns_is_turned(folder):
    alone = PHOTO.replace(b"irot", b"free")  # a box that says nothing
    (folder / "IMG_2.HEIC").write_bytes(alone)
    upright, turned, _ = read_photos(open_photos(find_photos(folder)), silent)
    assert turned.exif.orientation == 6
    assert turned.size == (48, 64)
    np.testing.assert_array_equal(turned.pixels, upright.pixels)


def with_nclx(primaries: int, curve: int) -> bytes:
    at = PHOTO.index(b"colrnclx") + 8
    return PHOTO[:at] + bytes([0, primaries, 0, curve]) + PHOTO[at + 4 :]


def test_colours_are_those_that_its_numbers_say(folder):
    """The primaries of Display P3, and of BT.2020, whose reds are outside of sRGB."""
    red = []
    for primaries in (1, 12, 9):
        (folder / "IMG_2.HEIC").write_bytes(with_nclx(primaries, 13))
        pixels = ImageFile(folder / "IMG_2.HEIC").read()
        red.append(pixels[24, 40])
    light = np.where(red[0] <= 0.04045, red[0] / 12.92, ((red[0] + 0.055) / 1.055) ** 2.4)
    for matrix, found in ((P3_TO_SRGB, red[1]), (BT2020_TO_SRGB, red[2])):
        moved = np.clip(matrix @ light, 0, 1)
        expected = np.where(moved <= 0.0031308, moved * 12.92, 1.055 * moved ** (1 / 2.4) - 0.055)
        assert np.abs(expected - red[0]).max() > 0.03
        np.testing.assert_allclose(found, expected, atol=2e-3)


def test_numbers_that_say_nothing_change_nothing(folder):
    (folder / "IMG_2.HEIC").write_bytes(with_nclx(2, 2))
    np.testing.assert_array_equal(ImageFile(folder / "IMG_2.HEIC").read(), ImageFile(folder / "IMG_1.heic").read())


@pytest.mark.parametrize(("curve", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_is_refused(folder, curve, name):
    (folder / "IMG_2.HEIC").write_bytes(with_nclx(9, curve))
    with pytest.raises(DataError, match=rf"IMG_2\.HEIC: expected a photo of standard range, got HDR \({name}\)"):
        read_photos(open_photos(find_photos(folder)), silent)


@pytest.mark.parametrize("end", [40, 300, 640])
def test_a_damaged_one_is_named(folder, end):
    (folder / "IMG_2.HEIC").write_bytes(PHOTO[:end])
    with pytest.raises(DataError, match=r"IMG_2\.HEIC: .*(damaged|cut short)"):
        read_photos(open_photos(find_photos(folder)), silent)


def test_a_bomb_is_not_decoded(folder, monkeypatch):
    for name, value in (("size", (2**15, 2**15)), ("width", 2**15), ("height", 2**15)):
        monkeypatch.setattr(pi_heif.HeifImageFile, name, value)
    with pytest.raises(DataError, match="32768x32768 pixels in 71[456] bytes: a decompression bomb"):
        read_photos(open_photos(find_photos(folder)), silent)


def test_without_the_extra_it_is_said_what_to_do(folder, monkeypatch):
    monkeypatch.setattr(folders, "has_heic", lambda: False)
    said = r"2 of 3 photos cannot be read \(IMG_1\.heic, IMG_2\.HEIC\).*\[heic\].*sips.*magick.*Most Compatible"
    with pytest.raises(DataError, match=said):
        find_photos(folder)
    with pytest.raises(DataError, match=r"IMG_3\.jpg: is a HEIC photo or a video"):
        open_photos([folder / "IMG_3.jpg"])


def test_of_a_photo_and_its_conversion_the_jpeg_is_taken(folder):
    (folder / "img_2.jpg").write_bytes(PHOTO)  # what `magick mogrify` leaves beside IMG_2.HEIC
    assert [path.name for path in find_photos(folder)] == ["IMG_1.heic", "IMG_3.jpg", "img_2.jpg"]
    (note,) = notes_on(folder, find_photos(folder))
    assert "IMG_2.HEIC" in note


def test_a_folder_without_photos_names_the_endings_that_are_read(tmp_path, monkeypatch):
    with pytest.raises(DataError, match=r"\.jpg .*\.heic"):
        find_photos(tmp_path)
    monkeypatch.setattr(folders, "has_heic", lambda: False)
    with pytest.raises(DataError) as error:
        find_photos(tmp_path)
    assert ".heic" not in str(error.value)
