# SPDX-License-Identifier: Apache-2.0
import gc
import os
from pathlib import Path

import pytest

from starpos.parallel import BLAS_THREADS

# Before numpy is loaded, as the command does.
os.environ |= dict.fromkeys(BLAS_THREADS, "1")

import numpy as np

SHARED = Path(__file__).resolve().parents[4] / "shared"


def pytest_collection_finish():
    """Modules and tests stay to the end: the collector need not look at them again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def triangle_cache(tmp_path_factory):
    """Triangle catalogues are built once: in the user's cache where there is one, else in a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        if not (home / "starpos").is_dir():
            patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def catalogue():
    from starpos.sky import catalogue

    return catalogue.load_catalogue()


@pytest.fixture
def rng(request):
    """A generator of random numbers, the same for a test in every run."""
    return np.random.default_rng(sum(request.node.name.encode()))


@pytest.fixture(scope="session")
def shared():
    """The folder of reference data next to the project; tests that need it skip without it."""
    if not SHARED.is_dir():
        pytest.skip("no reference data next to the project")
    return SHARED


@pytest.fixture
def unpainted(monkeypatch):
    """Figures are made and not painted, which takes most of a report's time; for tests that look at its text."""
    from matplotlib.figure import Figure

    from starpos.report import style

    blank = style.png_of(Figure(figsize=(0.1, 0.1)))
    monkeypatch.setattr(style, "png_of", lambda figure: blank)
