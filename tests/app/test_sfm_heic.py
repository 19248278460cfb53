"""HEIC photos: upright, with what they say of the lens; without their extra, with what to do."""

import base64
import zlib

import numpy as np
import pytest
from photo_folders import open_photos

from kgs._support.errors import DataError
from kgs._support.progress import silent
from kgs.app.sfm.find import find_photos
from kgs.app.sfm.read import read_photos
from kgs.datasets import folders
from kgs.datasets.image_file import ImageFile, is_heic

pi_heif = pytest.importorskip("pi_heif")

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


def with_nclx(primaries: int, curve: int) -> bytes:
    at = PHOTO.index(b"colrnclx") + 8
    return PHOTO[:at] + bytes([0, primaries, 0, curve]) + PHOTO[at + 4 :]


@pytest.mark.parametrize("numbers", [(2, 2), (1, 1), (1, 13), (5, 6)])
def test_numbers_that_mean_srgb_or_nothing_change_nothing(folder, numbers):
    (folder / "IMG_2.HEIC").write_bytes(with_nclx(*numbers))
    np.testing.assert_array_equal(ImageFile(folder / "IMG_2.HEIC").read(), ImageFile(folder / "IMG_1.heic").read())


@pytest.mark.parametrize("numbers", [(9, 16), (9, 18), (12, 13), (9, 13), (1, 8)])
def test_numbers_of_other_colours_are_refused(folder, numbers):
    (folder / "IMG_2.HEIC").write_bytes(with_nclx(*numbers))
    with pytest.raises(DataError, match=r"IMG_2\.HEIC: .*convert it to 8-bit RGB"):
        open_photos(find_photos(folder))


@pytest.mark.parametrize("end", [40, 300, 640])
def test_a_damaged_one_is_named(folder, end):
    (folder / "IMG_2.HEIC").write_bytes(PHOTO[:end])
    with pytest.raises(DataError, match=r"IMG_2\.HEIC: .*(damaged|cut short)"):
        read_photos(open_photos(find_photos(folder)), silent)


def test_a_bomb_is_not_decoded(folder, monkeypatch):
    for name, value in (("size", (2**15, 2**15)), ("width", 2**15), ("height", 2**15)):
        monkeypatch.setattr(pi_heif.HeifImageFile, name, value)
    with pytest.raises(DataError, match="in 71[456] bytes, got 32768x32768: it is a decompression bomb"):
        read_photos(open_photos(find_photos(folder)), silent)


def test_without_the_extra_it_is_said_what_to_do(folder, monkeypatch):
    monkeypatch.setattr(folders, "has_heic", lambda: False)
    said = r"(?s)2 of 3 of another kind \(IMG_1\.heic, IMG_2\.HEIC\).*\[heic\].*sips.*magick.*Most Compatible"
    with pytest.raises(DataError, match=said) as error:
        find_photos(folder)
    assert all(len(line) <= 120 for line in str(error.value.advice).splitlines())
    with pytest.raises(DataError, match=r"IMG_3\.jpg: .* got a HEIC photo or a video"):
        open_photos([folder / "IMG_3.jpg"])


def test_a_folder_without_photos_names_the_endings_that_are_read(tmp_path, monkeypatch):
    with pytest.raises(DataError, match=r"\.jpg .*\.heic"):
        find_photos(tmp_path)
    monkeypatch.setattr(folders, "has_heic", lambda: False)
    with pytest.raises(DataError) as error:
        find_photos(tmp_path)
    assert ".heic" not in str(error.value)
