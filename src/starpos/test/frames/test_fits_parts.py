# SPDX-License-Identifier: Apache-2.0
"""FITS files of several images: which is taken, how another one is named, and what damage to the others costs."""

import numpy as np
import pytest
from astropy.io import fits

from starpos.errors import FrameError
from starpos.frames.reading import read_frame, why_no_time

SKY = np.random.default_rng(7).normal(1000, 30, (60, 80)).astype(np.int16)


@pytest.fixture
def several(tmp_path):
    """A file of an empty first part with the time, a table, SCI, a cube, a packed image and a second SCI."""
    primary = fits.PrimaryHDU()
    primary.header["DATE-OBS"], primary.header["EXPTIME"] = "2026-11-02T18:00:00", 2.0
    table = fits.BinTableHDU.from_columns([fits.Column("a", "I", array=[1])], name="LOG")
    packed = fits.CompImageHDU(SKY + 2, name="DQ", compression_type="RICE_1")
    packed.header["EXPTIME"] = 4.0
    parts = [table, fits.ImageHDU(SKY, name="SCI"), fits.ImageHDU(np.zeros((4, 4, 5)), name="CUBE"), packed]
    again = fits.ImageHDU(SKY + 5, name="SCI")
    again.ver, again.header["INHERIT"] = 2, False
    path = tmp_path / "a.fits"
    fits.HDUList([primary, *parts, again]).writeto(path)
    return path


def test_the_first_image_is_taken_and_that_is_said(several):
    with pytest.warns(
        UserWarning, match=r"a\.fits: its HDU 2 is taken, of 3 images; .* like '.*a\.fits\[4\]'"
    ):
        frame = read_frame(several)
    assert np.array_equal(frame.pixels, SKY) and frame.exposure_s == 2.0
    assert frame.mid_unix_s is not None


@pytest.mark.parametrize(
    ("part", "more", "exposure_s"),
    [("2", 0, 2.0), ("SCI", 0, 2.0), ("sci,1", 0, 2.0), ("4", 2, 4.0), ("DQ", 2, 4.0), ("SCI,2", 5, None),
     ("5", 5, None)],
)  # fmt: skip
def test_another_image_is_named_by_its_number_or_its_name(several, part, more, exposure_s):
    frame = read_frame(f"{several}[{part}]")
    assert np.array_equal(frame.pixels, SKY + more)
    # what an image does not say itself the first part says, unless it forbids that
    assert frame.exposure_s == exposure_s
    assert frame.source == f"{several}[{part}]" and "DATE-OBS" in why_no_time(frame)


@pytest.mark.parametrize(
    ("part", "words"),
    [("9", "its images are 2 SCI, 3 CUBE, 4 DQ, 5 SCI"), ("NO", "no such HDU"), ("LOG", "this HDU is no image"),
     ("0", "this HDU is no image"), ("CUBE", "the image has 3 axes")],
)  # fmt: skip
def test_a_part_that_is_no_frame_is_refused(several, part, words):
    with pytest.raises(FrameError, match=words):
        read_frame(f"{several}[{part}]")


def test_three_colours_become_their_mean_without_a_mosaic(tmp_path):
    colours = np.stack([SKY, SKY + 5000, SKY * 2]).astype(np.uint16)
    hdu = fits.PrimaryHDU(colours)
    hdu.header["BAYERPAT"] = "RGGB"
    hdu.writeto(tmp_path / "a.fits")
    frame = read_frame(tmp_path / "a.fits")
    assert np.corrcoef(frame.pixels.ravel(), colours.mean(0).ravel())[0, 1] > 0.999999 and frame.pattern == ""
    # as stacking programs write them, from 0 to 1
    fits.PrimaryHDU((colours / 65535).astype(np.float32)).writeto(tmp_path / "b.fits")
    stacked = read_frame(tmp_path / "b.fits").pixels.astype(float)
    assert np.corrcoef(stacked.ravel(), frame.pixels.ravel())[0, 1] > 0.999999


def test_two_planes_are_no_colours(tmp_path):
    fits.PrimaryHDU(np.stack([SKY, SKY])).writeto(tmp_path / "a.fits")
    with pytest.raises(FrameError, match=r"3 axes \(80 x 60 x 2\); give one plane a file, or three colours"):
        read_frame(tmp_path / "a.fits")


def test_a_file_whose_name_ends_in_brackets_is_itself(tmp_path):
    fits.PrimaryHDU(SKY).writeto(tmp_path / "a.fits")
    fits.PrimaryHDU(SKY + 3).writeto(tmp_path / "x.fits")
    (tmp_path / "x.fits").rename(tmp_path / "a.fits[1]")
    with pytest.raises(FrameError, match="suffix"):
        read_frame(tmp_path / "a.fits[1]")
    assert np.array_equal(read_frame(tmp_path / "a.fits[0]").pixels, SKY)


def test_damage_behind_the_image_costs_nothing(several, tmp_path):
    whole = several.read_bytes()
    end = whole.index(b"XTENSION", whole.index(b"'SCI") + 2880)
    for rest in (b"", whole[end : end + 1000], b"\xff" * 2880):
        (tmp_path / "b.fits").write_bytes(whole[:end] + rest)
        assert np.array_equal(read_frame(tmp_path / "b.fits[SCI]").pixels, SKY)


def test_a_part_that_claims_gigabytes_is_refused(tmp_path):
    fits.HDUList([fits.PrimaryHDU(SKY), fits.ImageHDU(SKY, name="BIG")]).writeto(tmp_path / "a.fits")
    data = bytearray((tmp_path / "a.fits").read_bytes())
    for key in (b"NAXIS1  =", b"NAXIS2  ="):
        at = data.index(key, data.index(b"XTENSION"))
        data[at + 10 : at + 30] = b"999999999".rjust(20)
    (tmp_path / "a.fits").write_bytes(data)
    with pytest.raises(FrameError, match="claims"):
        read_frame(f"{tmp_path / 'a.fits'}[1]")


# the name has ms or us; the header's time counts before the name's
FF = "FF_XX0001_20240618_011731_867_1054720.fits", "FF_XX0001_20240618_011731_867123_1054720.fits"


@pytest.mark.parametrize(("name", "start"), [(FF[0], None), (FF[1], "2024-06-18T02:00:00")])
def test_a_stack_of_a_meteor_camera_is_its_mean_and_one_exposure(tmp_path, name, start):
    primary = fits.PrimaryHDU()
    primary.header.update({"NFRAMES": 256, "CAMNO": "XX0001"})
    # the rate is in the header, or in the configuration in its folder
    if start:
        primary.header["FPS"] = 25.0
    else:
        (tmp_path / ".config").write_text("[Capture]\nfps: 25.0 ; frames per second\n")
    if start:
        primary.header["DATE-OBS"] = start
    names = "MAXPIXEL", "MAXFRAME", "AVEPIXEL", "STDPIXEL"
    images = [fits.ImageHDU(np.full((72, 128), k, np.uint8), name=n) for k, n in enumerate(names)]
    fits.HDUList([primary, *images]).writeto(tmp_path / name)
    frame = read_frame(tmp_path / name)
    assert frame.exposure_s == 10.24 and (frame.pixels == 2).all()
    # 2024-06-18T01:17:31.867 or 02:00:00 (date -u -d ... +%s), and half of the exposure
    assert frame.mid_unix_s == pytest.approx((1718676000 if start else 1718673451.867) + 5.12, abs=1e-3)
