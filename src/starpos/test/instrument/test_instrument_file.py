# SPDX-License-Identifier: Apache-2.0
"""The instrument file: what is written is read again, what is no instrument is refused in a sentence."""

import resource
import warnings
from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.instrument_file import read, write
from starpos.rotation import from_vector

SIMPLE = "starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\n"
FULL = """starpos_instrument: 1
camera: {width: 1392, height: 1040, fx: 5200.5, fy: 5201.5, cx: 700.25, cy: 520, distortion: [-0.1, 0.01, 1e-3, -2e-3, 0]}
misalignment_deg: [0.1, -0.2, 30]
calibration_stddev_arcsec: [1, 2, 3]
link_to_camera: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
tilt_noise_deg: 0.002
clock_stddev_s: 0.001
"""
DATED = SIMPLE + "calibrated: {utc: 2026-11-02T18:00:00Z, %s}\n"
COVARIANCE = SIMPLE + "calibration_covariance_arcsec2: %s\n"


@pytest.fixture
def reads(tmp_path):
    def of(text):
        path = tmp_path / "instrument.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(path)

    return of


def test_the_shortest_file(reads):
    i = reads(SIMPLE)
    assert i.focal_px == 93750
    assert i == Instrument(93750.0)
    assert i.camera_for(100, 80) == Camera.from_focal(100, 80, 93750.0)


def test_every_key(reads):
    i = reads(FULL)
    assert i.camera == Camera(
        width=1392,
        height=1040,
        fx=5200.5,
        fy=5201.5,
        cx=700.25,
        cy=520.0,
        distortion=(-0.1, 0.01, 1e-3, -2e-3, 0.0),
    )
    assert i.focal_px == 5200.5
    assert i.calibration.misalignment_deg == (0.1, -0.2, 30.0)
    assert i.inclinometer.noise_rad == pytest.approx(np.radians(0.002))
    assert i.clock_stddev_s == 0.001
    np.testing.assert_allclose(
        np.sqrt(np.diag(i.calibration.covariance)), np.radians([1 / 3600, 2 / 3600, 3 / 3600])
    )
    np.testing.assert_array_equal(i.link_to_camera, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def test_the_camera_of_a_calibration_file_beside_it_or_elsewhere(reads, tmp_path):
    camera = Camera(
        width=1392,
        height=1040,
        fx=5200.5,
        fy=5201.5,
        cx=700.25,
        cy=520.0,
        distortion=(-0.1, 0.01, 1e-3, -2e-3, 0.0),
    )
    instrument_file.write_camera(tmp_path / "optics" / "camera.yaml", camera, "camera")
    for name in ("optics/camera.yaml", tmp_path / "optics" / "camera.yaml"):
        i = reads(f"starpos_instrument: 1\ncamera: {{calibration: {name}}}\n")
        assert (i.camera, i.focal_px) == (camera, 5200.5)


REFUSED = {
    "empty": ("", "first key"),
    "no mapping": ("- 1\n- 2\n", "first key"),
    "no format": ("camera: {focal_mm: 600, pixel_um: 6.4}\n", "first key"),
    "another format": (SIMPLE.replace(": 1", ": 2", 1), "first key"),
    "no camera": ("starpos_instrument: 1\n", "camera"),
    "camera of nothing": ("starpos_instrument: 1\ncamera:\n", "camera is missing: give {focal_mm"),
    "half a camera": ("starpos_instrument: 1\ncamera: {focal_mm: 600}\n", "pixel_um"),
    "unknown key": (SIMPLE + "misaligment_deg: [0, 0, 0]\n", "unknown key 'misaligment_deg'"),
    "unknown camera key": (SIMPLE.replace("}", ", distortions: [0, 0, 0, 0, 0]}"), "distortions"),
    "two cameras": (FULL.replace("width", "focal_mm: 600, pixel_um: 6.4, width"), "unknown key 'fx'"),
    "half a size": (
        "starpos_instrument: 1\ncamera: {focal_px: 900, width: 600}\n",
        "the camera's height is missing",
    ),
    "no calibration": (
        "starpos_instrument: 1\ncamera: {calibration: none.yaml}\n",
        "none.yaml: not a readable calib",
    ),
    "a calibration of nothing": (
        "starpos_instrument: 1\ncamera: {calibration: }\n",
        "calibration is missing: give",
    ),
    "a calibration and more": (
        "starpos_instrument: 1\ncamera: {calibration: a, width: 5}\n",
        "unknown key 'width'",
    ),
    "itself for a calibration": (
        "starpos_instrument: 1\ncamera: {calibration: instrument.yaml}\n",
        "image_width",
    ),
    "nan": (SIMPLE + "misalignment_deg: [.nan, 0, 0]\n", "within 360 deg"),
    "infinite size": (FULL.replace("1392", ".inf"), "width"),
    "fraction of a pixel": (FULL.replace("1392", "1392.5"), "width"),
    "infinite noise": (SIMPLE + "tilt_noise_deg: .inf\n", "tilt_noise_deg is inf: give a finite number"),
    "a negative clock": (
        SIMPLE + "clock_stddev_s: -1\n",
        "clock_stddev_s of the instrument is -1: it must be 0 or more",
    ),
    "two angles": (SIMPLE + "misalignment_deg: [0, 0]\n", "three numbers"),
    "text for angles": (SIMPLE + "misalignment_deg: '123'\n", "list of numbers"),
    "one angle": (SIMPLE + "misalignment_deg: 5\n", "list of numbers"),
    "no rotation": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]\n", "rotation"),
    "a mirror": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\n", "rotation"),
    "a ragged matrix": (SIMPLE + "link_to_camera: [[1, 0, 0], [0, 1], [0, 0, 1]]\n", ""),
    "zero focal length": (SIMPLE.replace("600", "0"), "positive"),
    "words": (SIMPLE.replace("600", "long"), "focal_mm is 'long': give a number"),
    "a number for a camera": ("starpos_instrument: 1\ncamera: 5\n", "camera is 5: give {focal_mm"),
    "a frame of terapixels": (FULL.replace("1392", "1" + "0" * 12), "width"),
    "a number beyond floats": (SIMPLE.replace("600", "0x" + "f" * 5000), "focal_mm is a number beyond"),
    "no noise at all": (SIMPLE + "tilt_noise_deg: 0\n", "tilt_noise_deg) is 0 deg: must be positive"),
    "yes for the noise": (SIMPLE + "tilt_noise_deg: yes\n", "tilt_noise_deg is True: give a number"),
    "true for an angle": (SIMPLE + "misalignment_deg: [0, true, 0]\n", "is True: give a number"),
    "a list for the noise": (SIMPLE + "tilt_noise_deg: [1]\n", "tilt_noise_deg is [1]: give a number"),
    "one error": (
        SIMPLE + "calibration_stddev_arcsec: 5\n",
        "calibration_stddev_arcsec is 5: give a list of numbers",
    ),
    "an error that is a word": (
        SIMPLE + "calibration_stddev_arcsec: [1, x, 1]\n",
        "calibration_stddev_arcsec is 'x'",
    ),
    "a matrix of nothing": (SIMPLE + "link_to_camera:\n", "link_to_camera is missing"),
    "no distortion": (FULL.replace("[-0.1, 0.01, 1e-3, -2e-3, 0]", "none"), "distortion is 'none'"),
    "a tag that lies": (
        SIMPLE + "clock_stddev_s: !!timestamp abc\n",
        "not a readable instrument file (it is no YAML)",
    ),
    "users of a machine": ("root:x:0:0:root:/root:/bin/bash\nbin:x:1:1\n", "first key"),
    "an equals sign": ("a: [=]\n", "not a readable instrument file (it is no YAML, line 1)"),
    "a value that starts with an equals sign": ("root: =\n", "instrument file"),
    "laughs": (
        "a: &a [x, x]\n"
        + "".join(
            f"{b}: &{b} [{', '.join(f'*{a}' for _ in range(9))}]\n" for a, b in pairwise("abcdefghijkl")
        )
        + "starpos_instrument: 1\ncamera: *l\n",
        "alias",
    ),
    "merges that double": (
        "starpos_instrument: 1\na: &a {x: 1}\n"
        + "".join(f"{b}: &{b} {{<<: [*{a}, *{a}]}}\n" for a, b in pairwise("abcdefghijklmnopqrstuvwxyz")),
        "alias",
    ),
    "a camera of laughs": (
        "starpos_instrument: 1\ncamera:\n"
        + "".join(
            ["  - &a [x, x]\n"]
            + [f"  - &{b} [{', '.join(f'*{a}' for _ in range(9))}]\n" for a, b in pairwise("abcdefghijkl")]
        ),
        "alias",
    ),
    "a key twice": (
        SIMPLE + "tilt_noise_deg: 0.002\ntilt_noise_deg: 0.2\n",
        "not a readable instrument file (line 4 gives tilt_noise_deg again: keep one of the two)",
    ),
    "a key twice inside": (
        "starpos_instrument: 1\ncamera: {focal_mm: 600, 'focal_mm': 60, pixel_um: 6}\n",
        "(line 2 gives focal_mm again",
    ),
    "a mapping for a key": ("? {a: 1}\n: 2\n? {a: 1}\n: 3\n", "not a readable instrument file"),
    "broken yaml": ("starpos_instrument: 1\ncamera: {focal_mm: [\n", "not a readable"),
    "an empty file of tags": ("!!binary 5\n", "instrument file"),
    "tabs": ("starpos_instrument: 1\n\tcamera: 1\n", "not a readable"),
    "binary": (bytes(range(256)), "not a readable"),
    "two documents": (SIMPLE + "---\n" + SIMPLE, "not a readable"),
    "huge": (SIMPLE + "#" * 64_000, "may have 64000"),
    "deep": ("starpos_instrument: 1\ncamera: " + "[" * 5000, "not a readable"),
    "five terms": (FULL.replace(", 0]}", "]}"), "plumb_bob"),
    "a date that is none": (SIMPLE + "clock_stddev_s: 2026-99-99\n", "not a readable"),
    "python object": (
        SIMPLE + "tilt_noise_deg: !!python/object/apply:os.system ['touch EXECUTED']\n",
        "not a readable",
    ),
    "python tuple": (SIMPLE + "misalignment_deg: !!python/tuple [0, 0, 0]\n", "not a readable"),
    "a covariance that leans": (COVARIANCE % "[[1, 2, 0], [0, 1, 0], [0, 0, 1]]", "symmetric"),
    "a negative variance": (COVARIANCE % "[[1, 0, 0], [0, -1, 0], [0, 0, 1]]", "negative"),
    "more correlation than there is": (COVARIANCE % "[[1, 2, 0], [2, 1, 0], [0, 0, 1]]", "negative"),
    "a small covariance": (COVARIANCE % "[[1, 0], [0, 1]]", "symmetric 3 x 3"),
    "a covariance in a row": (COVARIANCE % "[1, 2, 3]", "give a list of numbers"),
    "a covariance in words": (COVARIANCE % "[[a, 0, 0], [0, 1, 0], [0, 0, 1]]", "is 'a': give a number"),
    "a covariance of nothing": (COVARIANCE % "", "calibration_covariance_arcsec2 is missing"),
    "an empty covariance": (COVARIANCE % "[]", "the calibration's covariance"),
    "a covariance beyond sense": (
        COVARIANCE % "[[1e300, 0, 0], [0, 1e300, 0], [0, 0, 1]]",
        "beyond any turn",
    ),
    "one beyond floats": (
        COVARIANCE % "[[1e308, 1e308, 0], [1e308, 1e308, 0], [0, 0, 1]]",
        "beyond any turn",
    ),
    "an infinite covariance": (COVARIANCE % "[[1e400, 0, 0], [0, 1, 0], [0, 0, 1]]", "beyond any turn"),
    "a turn below zero": (SIMPLE + "remounted_arcsec: -1\n", "give 0 to"),
    "an error beyond floats": (SIMPLE + "calibration_stddev_arcsec: [1e200, 1, 1]\n", "at most"),
    "both": (
        COVARIANCE % "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]" + "calibration_stddev_arcsec: [1, 1, 1]\n",
        "give one of them",
    ),
    "calibrated at a number": (SIMPLE + "calibrated: 5\n", "calibrated is 5: give {utc"),
    "calibrated at no time": (SIMPLE + "calibrated: {frames: 3}\n", "calibrated: 'None' is no time"),
    "a time that is none": (SIMPLE + "calibrated: {utc: tonight}\n", "calibrated: 'tonight' is no time"),
    "a time that is a list": (SIMPLE + "calibrated: {utc: [2026]}\n", "is no time"),
    "a time of a machine": (SIMPLE + "calibrated: {utc: 1793642400}\n", "is no time"),
    "a time before time": (SIMPLE + "calibrated: {utc: 0001-01-01T00:00:00+23:00}\n", "is no time"),
    "a time after time": (SIMPLE + "calibrated: {utc: '9999-12-31T23:59:59-23:00'}\n", "is no time"),
    "calibrated by somebody": (DATED % "by: me", "unknown key 'by': the keys here are utc"),
    "minus a frame": (DATED % "frames: -1", "frames is -1: give a whole number"),
    "half a frame": (DATED % "frames: 1.5", "frames is 1.5: give a whole number"),
    "true frames": (DATED % "frames: true", "frames is True: give a whole number"),
    "frames beyond count": (DATED % ("frames: 1" + "0" * 400), "frames is a number beyond"),
    "valid for no time": (DATED % "valid_days: 0", "valid_days is 0.0: must be positive"),
    "valid for nobody knows how long": (DATED % "valid_days: .nan", "valid_days is nan"),
    "valid for words": (DATED % "valid_days: soon", "valid_days is 'soon': give a number"),
    "four tilts": (DATED % "tilt_deg: [1, 2, 3, 4]", "two or three axes"),
    "one tilt": (DATED % "tilt_deg: 5", "tilt_deg is 5: give a list"),
    "a tilt beyond range": (DATED % "tilt_deg: [80, 80]", "is impossible: give the elevations"),
    "as hot as a star": (DATED % "temperature_c: 6000", "temperature_c of the calibration is 6000"),
    "a drift back": (
        SIMPLE + "tilt_drift_arcsec_per_sqrt_hour: -1\n",
        "tilt_drift_arcsec_per_sqrt_hour is -1: give",
    ),
    "a step of more than a turn": (
        SIMPLE + "tilt_quantum_deg: 1e300\n",
        "tilt_quantum_deg is 1e+300: give a finite",
    ),
    "a scale of two": (SIMPLE + "tilt_scale: 2\n", "tilt_scale is 2: give a finite number from 0 to 1"),
    "a temperature's words": (SIMPLE + "tilt_temperature_arcsec_per_c: warm\n", "is 'warm': give a number"),
    "many turns": (SIMPLE + "misalignment_deg: [1e300, 0, 0]\n", "within 360 deg"),
    "a link beyond floats": (SIMPLE + "link_to_camera: [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]\n", "rotation"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_with_one_sentence_that_names_the_file(kind, reads, tmp_path):
    text, words = REFUSED[kind]
    with warnings.catch_warnings(), pytest.raises(InstrumentError) as e:
        # Would reach the user's screen.
        warnings.simplefilter("error")
        reads(text.replace("EXECUTED", str(tmp_path / "executed")) if isinstance(text, str) else text)
    assert words in str(e.value)
    assert "instrument.yaml" in str(e.value)
    assert "\n" not in str(e.value)
    assert not (tmp_path / "executed").exists()


def test_a_file_that_is_not_there_and_a_folder(tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(InstrumentError, match="not a readable instrument file"):
            read(path)


def random_instrument(rng, full: bool) -> Instrument:
    """Any instrument, with its intrinsics or a focal length alone; its time to the millisecond, as files have it."""
    root = rng.normal(size=(3, 3)) * 10 ** rng.uniform(-3, 4)
    calibration = Calibration(
        misalignment_deg=tuple(rng.uniform(-180, 180, 3).tolist()),
        covariance_arcsec2=tuple(map(tuple, (root @ root.T).tolist())),
        remounted_arcsec=float(rng.choice([0.0, rng.uniform(0, 1000)])),
        utc_unix_s=round(float(rng.uniform(0, 2e9)), 3),
        temperature_c=float(rng.choice([np.nan, rng.uniform(-40, 60)])),
        tilt_deg=tuple(rng.uniform(-30, 30, 2).tolist()),
        frames=int(rng.integers(0, 1000)),
        valid_days=float(rng.choice([np.inf, rng.uniform(0.1, 1e4)])),
    )
    focal = float(rng.uniform(1e3, 1e5))
    width, height = (int(n) for n in rng.integers(100, 9000, 2))
    camera = Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal * 1.001,
        cx=width * rng.uniform(0.3, 0.7),
        cy=height * rng.uniform(0.3, 0.7),
        distortion=tuple(rng.normal(0, 0.1, 5).tolist()),
    )
    names = [f.name for f in fields(InclinometerErrors)]
    errors = InclinometerErrors(**dict(zip(names, (10 ** rng.uniform(-8, -3, 8)).tolist(), strict=True)))
    link = tuple(map(tuple, from_vector(rng.normal(size=3)).tolist()))
    clock = float(10 ** rng.uniform(-6, 1))
    return Instrument(
        focal,
        camera=camera if full else None,
        calibration=calibration,
        link_to_camera=link,
        inclinometer=errors,
        clock_stddev_s=clock,
    )


def numbers(i: Instrument) -> np.ndarray:
    c = i.calibration
    return np.array(
        [
            i.focal_px,
            *c.misalignment_deg,
            *np.ravel(c.covariance_arcsec2),
            c.temperature_c,
            *c.tilt_deg,
            c.frames,
            c.valid_days,
            *np.ravel(i.link_to_camera),
            *vars(i.inclinometer).values(),
            i.clock_stddev_s,
        ]
    )


@pytest.mark.parametrize("full", [False, True])
def test_what_is_written_is_read(full, rng, tmp_path):
    for _ in range(25):
        i = random_instrument(rng, full)
        write(tmp_path / "i.yaml", i, "a line for people: {not: yaml}\nanother")
        text = (tmp_path / "i.yaml").read_text().partition("# by starpos")[0]
        again = read(tmp_path / "i.yaml")
        assert again.camera == i.camera
        np.testing.assert_allclose(numbers(again), numbers(i), rtol=1e-14)
        assert again.calibration.utc_unix_s == pytest.approx(i.calibration.utc_unix_s, abs=1.1e-3)
        # From then on it is the same to the last bit.
        write(tmp_path / "again.yaml", again)
        assert (tmp_path / "again.yaml").read_text() == text


@pytest.mark.parametrize("camera", ["focal_mm: 600, pixel_um: 6.4", "focal_px: 93750"])
def test_the_size_of_the_frame_that_a3_belongs_to_is_kept(camera, reads, tmp_path):
    i = reads(f"starpos_instrument: 1\ncamera: {{{camera}, width: 600, height: 400}}\n")
    assert (i.size, i.camera) == ((600, 400), None)
    write(tmp_path / "again.yaml", i)
    assert read(tmp_path / "again.yaml") == i


def test_numbers_are_written_as_people_gave_them(tmp_path):
    given = """starpos_instrument: 1
camera: {focal_mm: 600, pixel_um: 6.4}
tilt_noise_deg: 0.0035
tilt_drift_arcsec_per_sqrt_hour: 2.1
tilt_quantum_deg: 0.0005
tilt_temperature_arcsec_per_c: 3.3
"""
    (tmp_path / "given.yaml").write_text(given)
    write(tmp_path / "i.yaml", read(tmp_path / "given.yaml"))
    text = (tmp_path / "i.yaml").read_text()
    for line in given.splitlines()[2:]:
        assert f"{line}\n" in text


def test_what_nobody_knows_is_not_written(tmp_path):
    write(tmp_path / "i.yaml", Instrument(5000.0))
    assert "calibrated" not in (tmp_path / "i.yaml").read_text()
    np.testing.assert_array_equal(numbers(read(tmp_path / "i.yaml")), numbers(Instrument(5000.0)))
    write(tmp_path / "i.yaml", Instrument(5000.0, calibration=Calibration(utc_unix_s=1e9)))
    (line,) = [x for x in (tmp_path / "i.yaml").read_text().splitlines() if x.startswith("calibrated")]
    assert "temperature_c" not in line and "valid_days" not in line
    back = read(tmp_path / "i.yaml").calibration
    assert np.isnan(back.temperature_c) and back.valid_days == np.inf and back.utc_unix_s == 1e9


@pytest.mark.parametrize(
    "utc",
    [
        "2026-11-02T18:00:00Z",
        "2026-11-02 18:00:00",
        "'2026-11-02T18:00:00.000Z'",
        "2026-11-02T20:00:00+02:00",
        "2026-11-02t18:00:00.0Z",
    ],
)
def test_times_as_people_and_yaml_write_them(utc, reads):
    """Unquoted, YAML makes something of its own of them."""
    assert reads(SIMPLE + f"calibrated: {{utc: {utc}}}\n").calibration.utc_unix_s == 1793642400


def test_every_error_of_the_inclinometer_has_its_unit(reads):
    i = reads(
        SIMPLE + "tilt_noise_deg: 0.01\ntilt_quantum_deg: 0.02\ntilt_drift_arcsec_per_sqrt_hour: 3\n"
        "tilt_temperature_arcsec_per_c: 4\ntilt_scale: 5e-4\ntilt_cross: 6e-3\ntilt_pose_arcsec: 7\ntilt_range_deg: 45\n"
    )
    arcsec = np.pi / 648000
    assert list(vars(i.inclinometer).values()) == pytest.approx(
        [36 * arcsec, 72 * arcsec, 3 * arcsec, 4 * arcsec, 5e-4, 6e-3, 7 * arcsec, np.pi / 4]
    )


def test_a_calibration_with_all_it_says(reads):
    text = DATED % "temperature_c: 11.5, tilt_deg: [1, -2], frames: 12, valid_days: 30"
    c = reads(text + "calibration_covariance_arcsec2: [[4, 1, 0], [1, 9, 0], [0, 0, 16]]\n").calibration
    assert (c.temperature_c, c.tilt_deg, c.frames, c.valid_days) == (11.5, (1.0, -2.0), 12, 30.0)
    assert c.covariance_arcsec2 == ((4, 1, 0), (1, 9, 0), (0, 0, 16))


def test_a_disk_that_is_full_leaves_the_old_file(tmp_path):
    path = tmp_path / "i.yaml"
    write(path, Instrument(5000.0))
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(InstrumentError, match=r"i\.yaml: the file cannot be written there"):
            write(path, Instrument(6000.0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    # Nothing half written next to it.
    assert list(tmp_path.iterdir()) == [path]


def test_where_no_file_can_be(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "i.yaml", tmp_path / "folder", tmp_path / "a\0b"):
        with pytest.raises(InstrumentError, match="the file cannot be written there") as e:
            write(path, Instrument(5000.0))
        assert "\n" not in str(e.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
