# SPDX-License-Identifier: Apache-2.0
"""The photograph of a report: turned as it was held, with the names of its stars."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from starpos.fix.solution import Status
from starpos.frames.frame import Frame, Stars
from starpos.frames.gravity import Gravity
from starpos.night.night import Shot
from starpos.report import photograph

SIZE = WIDTH, HEIGHT = 400, 300
STAR = np.array([[70.0, 40.0]])


class _Night:
    shots = (
        Shot(name="a.jpg", status=Status.OK, message="", names=("HIP 24608",), stars_detected=1),
        Shot(name="b.jpg", status=Status.POOR_FIT, message=""),
    )


def identified(frame):
    """Capella, as the only star."""
    one = dict.fromkeys(("flux", "snr"), np.ones(1)) | {
        "covariance": np.eye(2)[None],
        "flags": np.ones(1, np.uint8),
    }
    stars = Stars(x=STAR[:, 0], y=STAR[:, 1], width=WIDTH, height=HEIGHT, **one)
    solution = SimpleNamespace(star=np.array([0]), names=("HIP 24608",), magnitudes=np.array([0.2]))
    return SimpleNamespace(stars=stars, solution=solution)


@pytest.mark.parametrize(
    ("up", "where"),
    [
        ((0, -1), (70, 40)),
        # held so that the right side of the stored picture was up
        ((1, 0), (40, WIDTH - 1 - 70)),
        ((0, 1), (WIDTH - 1 - 70, HEIGHT - 1 - 40)),
        ((-1, 0), (HEIGHT - 1 - 40, 70)),
    ],
)
def test_the_star_is_circled_in_the_picture_as_it_was_held(monkeypatch, up, where):
    pixels = np.full((HEIGHT, WIDTH), 10, np.uint8)
    pixels[40, 70] = 255
    frame = Frame(pixels, gravity=Gravity(np.array([*up, 0.0])))
    monkeypatch.setattr(photograph, "read_frame", lambda path: frame)
    monkeypatch.setattr(photograph, "Solving", lambda *given, **more: identified)
    written = []
    annotate = photograph.annotate
    monkeypatch.setattr(photograph, "annotate", lambda *a: written.extend(a[2].names) or annotate(*a))
    made = photograph.named_photograph(_Night(), {"a.jpg": "a.jpg"})
    shown = cv2.imdecode(np.frombuffer(made.png, np.uint8), cv2.IMREAD_COLOR)
    assert "a.jpg" in made.title and written == ["Capella"]
    _, green, red = np.moveaxis(shown.astype(int), -1, 0)
    x, y = np.argwhere(green - red > 40).T[::-1] - np.reshape(where, (2, 1))
    # the circle goes all around; its name is on one side
    ring = np.hypot(x, y) < 12
    assert len(set(np.degrees(np.arctan2(y, x))[ring] // 45 % 8)) == 8
    assert (shown[where[1] - 1 : where[1] + 2, where[0] - 1 : where[0] + 2] > 100).any()


def test_without_an_identified_frame_there_is_no_picture():
    night = _Night.shots[1:]
    assert photograph.named_photograph(type("N", (), {"shots": night}), {}) is None
