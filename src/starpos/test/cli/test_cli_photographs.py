# SPDX-License-Identifier: Apache-2.0
"""A place from photographs alone: pictures that Pillow wrote as a telephone does, of a simulated sky."""

import importlib.util
import struct
from datetime import datetime, timedelta, timezone

import cv2
import numpy as np
import pytest
from cli_calls import PLACE, WIDE, objects

import starpos
from starpos.cli import main
from starpos.frames.reading import read_frame
from starpos.instrument.inclinometer import up_of
from starpos_testing.lacking import needs

pytestmark = [needs("PIL"), needs("exifread")]
HEIC = "heic" if importlib.util.find_spec("pillow_heif") else "jpeg"
ZONE = timezone(timedelta(hours=-8))
# of 4636 px across 1000 x 700 px
FILM_MM = 164


def note(up):
    """Apple's note with gravity for up (3,) in the stored picture."""
    values = b"".join(struct.pack(">ii", round(x * 1e6), 1000000) for x in (up[1], up[0], up[2]))
    return b"Apple iOS\0\0\1MM" + struct.pack(">HHHIII", 1, 8, 10, 3, 32, 0) + values


def save(path, grey, mid_unix_s, up, film_mm=FILM_MM, model="iPhone 12 Pro", zone="-08:00", **left_out):
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    begin = datetime.fromtimestamp(mid_unix_s - 0.25, ZONE)
    below = {
        0x829A: IFDRational(1, 2),
        0x9003: begin.strftime("%Y:%m:%d %H:%M:%S"),
        0x9291: f"{begin.microsecond // 1000:03d}",
    }
    below |= {0x9011: zone, 0xA405: film_mm} | ({} if up is None else {0x927C: note(up)})
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Apple", model, 6
    exif[0x8769] = {tag: value for tag, value in below.items() if tag not in left_out.get("tags", ())}
    # 11 km north of the true place
    exif[0x8825] = {1: "N", 2: (47.0, 24.0, 0.0), 3: "W", 4: (122.0, 48.0, 0.0)}
    # Pillow writes the note as numbers, cameras as bytes
    data = exif.tobytes().replace(b"\x92\x7c\x00\x01", b"\x92\x7c\x00\x07")
    if path.suffix == ".heic":
        import pillow_heif

        pillow_heif.register_heif_opener()
    Image.fromarray(np.dstack([grey] * 3)).save(path, quality=95, exif=data)


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """Three frames of a telephone that lies on a table and is turned by 120 deg: pixels, time, up in the picture."""
    folder = tmp_path_factory.mktemp("sky")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    assert (
        main(
            [
                "simulate",
                str(folder),
                "-n",
                "3",
                "--turn",
                "120",
                "--altitude",
                "86",
                "--size",
                "1000",
                "700",
                *WIDE,
                *place,
            ]
        )
        == 0
    )
    tilts, seen = starpos.read_tilt_csv(folder / "tilt.csv"), []
    for path in sorted(folder.glob("*.fits")):
        frame = read_frame(path)
        light = frame.pixels - np.median(frame.pixels)
        grey = np.clip(12 + light / 12, 0, 255).astype(np.uint8)
        tilt = tilts.average(frame.mid_unix_s, frame.exposure_s)
        seen.append((grey, frame.mid_unix_s, up_of(tilt.theta)))
    return seen


@pytest.fixture(scope="module")
def photographs(sky, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    for k, (grey, mid_unix_s, up) in enumerate(sky):
        save(folder / f"IMG_{k}.{HEIC if k == 2 else 'jpg'}", grey, mid_unix_s, up)
    # a telephone keeps films in the same folder
    (folder / "IMG_2.mov").write_bytes(b"no picture")
    return folder


def km_off(answer):
    east = (answer["longitude"] - PLACE["longitude"]) * 111.3 * np.cos(np.radians(PLACE["latitude"]))
    return np.hypot(east, (answer["latitude"] - PLACE["latitude"]) * 111.2)


def test_photographs_alone_give_a_place(photographs, run):
    status, out, said = run("solve", *sorted(photographs.glob("*[!v]")), "--json")
    *each, whole = objects(out)
    assert status == 0 and [a["status"] for a in each] == ["ok"] * 3
    # its level is wrong by 0.35 deg in each axis, and the three headings show that
    assert all(30e3 < a["sigma_north_m"] < 50e3 for a in each)
    assert whole["sigma_north_m"] < 10e3 and km_off(whole) < 1
    assert whole["budget"]["clock"][0] == pytest.approx(464 * np.cos(np.radians(47.3)), rel=0.01)
    text = "\n".join(said)
    assert "gravity in the files" in text and "11 km from the GPS place in the file, within the claim" in text
    assert "--self-calibrate finds the error of its level, for a place to about 5." in text
    assert "km without it)" in text


def test_turning_finds_the_error_of_the_level(sky, tmp_path, run):
    # 0.5 deg about the long side
    wrong = np.array([[1, 0, 0], [0, np.cos(0.0087), -np.sin(0.0087)], [0, np.sin(0.0087), np.cos(0.0087)]])
    for k, (grey, mid_unix_s, up) in enumerate(sky):
        save(tmp_path / f"IMG_{k}.jpg", grey, mid_unix_s, wrong @ up)
    status, out, _ = run("solve", tmp_path, "--self-calibrate", "--save", tmp_path / "phone.yaml", "--json")
    whole = objects(out)[-1]
    assert status == 0 and whole["sigma_north_m"] < 10e3 and km_off(whole) < 3
    status, out, _ = run("solve", tmp_path / "IMG_1.jpg", "--instrument", tmp_path / "phone.yaml", "--json")
    assert status == 0 and km_off(objects(out)[-1]) < 3


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({0x927C}, "does not say which way is down"),
        ({0x9011}, "--exif-utc-offset"),
        ({0x829A}, "ExposureTime"),
    ],
)
def test_a_photograph_that_lacks_something_is_left_out_with_a_sentence(
    sky, photographs, tmp_path, run, tags, why
):
    grey, mid_unix_s, up = sky[1]
    save(tmp_path / "poor.jpg", grey, mid_unix_s, up, tags=tags)
    status, out, said = run("solve", tmp_path / "poor.jpg", photographs / "IMG_0.jpg", "--json")
    poor, good, whole = objects(out)
    assert status == 0 and poor["latitude"] is None and good["status"] == "ok" and whole["frames"] == 1
    assert any("poor.jpg" in line and why in line for line in said)


def test_a_copy_counts_once_and_another_telephone_has_a_level_of_its_own(sky, photographs, tmp_path, run):
    for name, model in (("copy.jpg", "iPhone 12 Pro"), ("other.jpg", "iPhone SE")):
        save(tmp_path / name, *sky[int(name == "other.jpg")], model=model)
    first, copy, other = photographs / "IMG_0.jpg", tmp_path / "copy.jpg", tmp_path / "other.jpg"
    status, out, said = run("solve", first, copy, other, "--json")
    *_, refused, whole = objects(out)
    assert status == 0 and whole["frames"] == 1 and refused["latitude"] is None
    assert any("1 of the photographs are copies" in line for line in said)
    assert any("other.jpg: it is by another camera (Apple iPhone SE)" in line for line in said)


def test_gps_in_the_file_tells_that_the_zone_is_wrong(sky, tmp_path, run):
    save(tmp_path / "IMG.jpg", *sky[1], zone="-07:00")
    _, _, said = run("solve", tmp_path / "IMG.jpg")
    assert any("beyond the claim: as of a clock 1 h behind the zone in the file" in line for line in said)


def test_a_photograph_that_other_code_drew(shared, tmp_path, run):
    """Its file, its sky and its telephone's errors are of a program that shares nothing with this one."""
    spec = importlib.util.spec_from_file_location("phone", shared / "phone" / "phone.py")
    phone = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(phone)
    lat, lon = phone.shoot("one", 5, tmp_path / "one")
    status, out, _ = run("solve", *(tmp_path / "one").glob("*"), "--json")
    answer = objects(out)[0]
    off = (answer["longitude"] - lon) * np.cos(np.radians(lat)), answer["latitude"] - lat
    km = 111.2 * np.array(off)
    assert status == 0 and answer["sigma_north_m"] < 60e3
    assert km @ np.linalg.solve(np.array(answer["covariance"])[:2, :2] / 1e6, km) < 19.3


def test_photographs_by_several_lenses_are_each_solved_by_its_own(sky, photographs, tmp_path, run):
    """A longer lens shows the middle of the first picture, twice as large; pixels grow about the frame's centre."""
    grey, mid_unix_s, up = sky[0]
    middle = cv2.resize(grey[175:525, 250:750], (1000, 700), interpolation=cv2.INTER_CUBIC)
    save(tmp_path / "IMG_9.jpg", middle, mid_unix_s, up, film_mm=2 * FILM_MM)
    status, out, said = run("solve", tmp_path / "IMG_9.jpg", photographs / "IMG_0.jpg", "--json")
    tele, wide, whole = objects(out)
    assert status == 0 and tele["status"] == wide["status"] == "ok" and whole["frames"] == 2
    assert abs(tele["latitude"] - wide["latitude"]) < 0.002 and km_off(whole) < 1
    for name, px in (("IMG_9", 9272), ("IMG_0", 4636)):
        (line,) = (line for line in said if name in line and "its stars give" in line)
        assert float(line.split()[-2]) == pytest.approx(px, rel=3e-3)


def log_of(path, sky, sign=-1.0):
    """Sensor Logger's Gravity.csv of the telephone that took the pictures; sign: -1 as on iOS, downward."""
    rows = ["time,seconds_elapsed,z,y,x"]
    for k, (_, mid_unix_s, up) in enumerate(sky):
        x, y, z = -sign * 9.81 * np.array([-up[1], -up[0], -up[2]])
        # a hand shakes the last digits
        rows += [
            f"{round((mid_unix_s + t) * 1e9)},{t},{z + 1e-4 * n},{y},{x + 3e-4 * (n % 3) + 1e-4 * k}"
            for n, t in enumerate(np.arange(-1, 1, 0.05))
        ]
    path.write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_log_beside_photographs_without_gravity_is_all_that_is_typed(sky, tmp_path, run, sign):
    for k, (grey, mid_unix_s, up) in enumerate(sky):
        save(tmp_path / f"IMG_{k}.jpg", grey, mid_unix_s, up, tags={0x927C})
    log_of(tmp_path / "Gravity.csv", sky, sign)
    pictures = sorted(tmp_path.glob("*.jpg"))
    status, out, said = run("solve", *pictures, "--tilt", tmp_path / "Gravity.csv", "--json")
    whole = objects(out)[-1]
    assert status == 0 and whole["sigma_north_m"] < 20e3 and km_off(whole) < 5
    assert any("the level is the telephone's log" in line for line in said)


def test_a_log_that_the_orientation_contradicts_is_refused(sky, tmp_path, run):
    """A sensor that lies the other way, as of some Androids; its camera leans, so that an edge is clearly up."""
    grey, mid_unix_s, _ = sky[0]
    up = np.array([-0.7, 0.0, 0.714])
    save(tmp_path / "IMG.jpg", grey, mid_unix_s, up, tags={0x927C})
    log_of(tmp_path / "Gravity.csv", [(grey, mid_unix_s, up * [-1, -1, 1])])
    status, _, said = run("solve", tmp_path / "IMG.jpg", "--tilt", tmp_path / "Gravity.csv")
    assert status == 1 and any("another edge was up than the telephone's log" in line for line in said)


def test_a_cut_out_of_a_photograph_is_refused(sky, tmp_path, run):
    grey, mid_unix_s, up = sky[1]
    save(tmp_path / "cut.jpg", grey[100:660, 100:900], mid_unix_s, up)
    status, _, said = run("solve", tmp_path / "cut.jpg")
    assert status == 1 and any("cut.jpg" in line and "a part of a photograph" in line for line in said)


def test_a_film_among_photographs_leaves_them_their_place(photographs, run):
    _, out, said = run("solve", photographs / "IMG_0.jpg", photographs / "IMG_2.mov", "--json")
    assert objects(out)[-1]["frames"] == 1 and any("IMG_2.mov: the suffix" in line for line in said)


def test_a_folder_of_photographs_is_a_night(photographs):
    night = starpos.open_night(photographs).solve()
    assert night.combined.frames == 3 and np.degrees(night.combined.latitude) == pytest.approx(47.3, abs=0.01)
