# SPDX-License-Identifier: Apache-2.0
import pytest


@pytest.fixture
def unpainted(monkeypatch):
    """Figures are made and not painted, which takes most of a report's time; for tests that look at its text."""
    from matplotlib.figure import Figure

    from starpos.report import style

    blank = style.png_of(Figure(figsize=(0.1, 0.1)))
    monkeypatch.setattr(style, "png_of", lambda figure: blank)
