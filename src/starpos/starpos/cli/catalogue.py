# SPDX-License-Identifier: Apache-2.0
"""`starpos catalogue`: shows the catalogues of stars and triangles, puts Gaia's places in, keeps a deeper one."""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from starpos.cli import console, options, overwriting
from starpos.errors import CatalogueError
from starpos.instrument.camera import Camera
from starpos.sky import catalogue, deeper
from starpos.table_cache import cache_folder


def run_info(args: argparse.Namespace) -> int:
    """Print the stars, magnitudes and errors of a catalogue."""
    c = catalogue.load_catalogue(args.path)
    v = c.vmag()
    sigma_mas = c.sigma(slice(None), args.year) / catalogue.MAS
    print(
        f"{len(c)} stars of Tycho-2, V {v.min():.2f} to {v.max():.2f}, {np.count_nonzero(c.hip)} with a HIP number"
    )
    print("   V up to     stars   median error of a place in", args.year)
    for limit in (2, 4, 6, 7, 8, 9, 9.5, 10, 10.5, 11, 12, 13):
        if limit > v.max() + 1:
            break
        inside = v < limit
        print(f"   {limit:7.1f} {inside.sum():9d}   {np.median(sigma_mas[inside]):6.0f} mas")
    if args.path is None:
        more = deeper.kept()
        print(
            "no deeper catalogue in the cache: small fields need one (`starpos catalogue deepen FILE`)"
            if more is None
            else f"{len(more)} stars of the deeper catalogue are in the cache, for small fields"
        )
    print("Tycho-2: Hog et al. 2000, A&A 355, L27; distributed by Debian under the 2-clause BSD licence")
    return 0


def run_build(args: argparse.Namespace) -> int:
    """Put the places of a Gaia extract into the catalogue in use; raises CatalogueError."""
    from starpos.sky import gaia

    overwriting.check(args, out=overwriting.stars)
    year = float(time.gmtime().tm_year) if args.year is None else args.year
    made, number = gaia.with_gaia(catalogue.load_catalogue(), gaia.read(Path(args.gaia)), year)
    try:
        catalogue.save(made, args.out)
    except OSError as e:
        raise CatalogueError(f"{args.out}: cannot be written ({e.strerror}): give another --out") from None
    size = Path(args.out).stat().st_size / 1e6
    print(
        f"{args.out}: {len(made)} stars to V = {made.vmag().max():.2f}, {number} of them with Gaia's places about "
        f"{year:g}, {size:.1f} MB",
        file=sys.stderr,
    )
    return 0


def run_deepen(args: argparse.Namespace) -> int:
    """Keep a deeper catalogue in the cache; raises CatalogueError."""
    made = deeper.keep(catalogue.read(args.path))
    print(
        f"{len(made)} stars are kept in {cache_folder()}: small fields take them from now on", file=sys.stderr
    )
    return 0


def run_triangles(args: argparse.Namespace) -> int:
    """Print the catalogue of triangles of a field."""
    from starpos.fix.solver import Solver
    from starpos.identification import triangles
    from starpos.instrument.instrument import Instrument

    camera, progress = options.camera_of(args), console.ProgressBar()
    Solver(Instrument(camera.fx), catalogue.load_catalogue(), progress=progress).prepare(
        camera.width, camera.height
    )
    c = deeper.for_field(catalogue.load_catalogue(), camera)
    table = triangles.cached_triangles(c, camera.half_diagonal_rad)
    used = np.unique(table.corners)
    size = sum(getattr(table, column).nbytes for column in table.__dataclass_fields__) / 1e6
    width, height = np.degrees(2 * np.arctan([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy]))
    print(
        f"field of {width:.2f} x {height:.2f} deg, {2 * np.degrees(camera.half_diagonal_rad):.2f} deg across"
    )
    print(
        f"{len(table.corners)} triangles of {len(used)} stars, V to {c.vmag(table.star[used]).max():.2f}; {size:.0f} MB"
    )
    on_frame = _stars_on_frames(camera, c.directions(table.star[used]))
    shares = np.percentile(on_frame, (0, 1, 10, 50, 90, 99, 100)).astype(int)
    print("of these a frame holds at least, in 1 %, 10 %, the median, 90 %, 99 %, at most:", *shares)
    return 0


def _stars_on_frames(camera: Camera, v: np.ndarray, frames: int = 2000) -> np.ndarray:
    """Numbers (frames,) of the directions v (N, 3) that lie on each of random frames."""
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    attitudes = Rotation.random(frames, random_state=1).as_matrix()
    near = cKDTree(v).query_ball_point(attitudes[:, 2], 2 * np.sin(camera.half_diagonal_rad / 2))
    size = [camera.width - 0.5, camera.height - 0.5]
    return np.array(
        [
            ((xy >= -0.5) & (xy <= size)).all(1).sum()
            for xy in (camera.project(v[rows] @ a.T) for rows, a in zip(near, attitudes, strict=True))
        ]
    )
