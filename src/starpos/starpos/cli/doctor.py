# SPDX-License-Identifier: Apache-2.0
"""`starpos doctor`: which parts that starpos needs this machine has, which are missing, and what to type.

A package that may be missing is imported only inside its check.
"""

import argparse
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from enum import Enum
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from starpos import __version__
from starpos.cli import console
from starpos.cli.commands import DATA
from starpos.errors import StarposError, one_line
from starpos.files import rows_of
from starpos.units import DAY_S

PACKAGES = DATA / "packages.yaml"
# OpenCV is one package of several
CV2 = ("opencv-python-headless", "opencv-python", "opencv-contrib-python")
SERIAL = ("dev/serial/by-id/*", "dev/ttyUSB*", "dev/ttyACM*")
# interface class of a photo camera, in USB's list
STILL_IMAGE = "06"
# Maximum size of the system's description of a device.
MAX_BYTES = 4096


class State(str, Enum):
    """What a check found."""

    OK = "ok"
    NOTE = "note"
    MISSING = "MISSING"


@dataclass(frozen=True)
class Finding:
    """What a check found: a sentence, and what to type if something is to be done."""

    state: State
    found: str
    cure: str = ""


ok, note, missing = (partial(Finding, state) for state in State)


def run(args: argparse.Namespace) -> int:
    any_missing = False
    for name, check in CHECKS.items():
        finding = _safely(check)
        if args.live and name in LIVE and finding.state is State.NOTE:
            finding = replace(finding, state=State.MISSING)
        any_missing |= finding.state is State.MISSING
        console.tell(args, {"check": name} | asdict(finding), _lines(name, finding))
    return console.NOTHING if any_missing else 0


def _lines(name: str, finding: Finding) -> str:
    cure = f"\n{'':26}-> {finding.cure}" if finding.cure else ""
    return f"{finding.state.value:<8}{name:<16}  {finding.found}{cure}"


def _safely(check: Callable[[], Finding]) -> Finding:
    """The finding of a check; a check that lacks a package or a permission says so."""
    try:
        return check()
    except ImportError as error:
        return missing(f"cannot be determined: {one_line(error)}", "see the packages that are missing")
    except (StarposError, OSError) as error:
        return missing(one_line(error))


def versions() -> Finding:
    """The versions of starpos, Python and the system."""
    system = f"{platform.system()} {platform.machine()}"
    return ok(f"{__version__} in {Path(__file__).parents[1]}, Python {platform.python_version()}, {system}")


def packages() -> Finding:
    """The packages that everything needs, and their versions."""
    lacking = [
        package for module, package in rows_of(PACKAGES)["needed"].items() if find_spec(module) is None
    ]
    if lacking:
        return missing(f"not here: {', '.join(lacking)}", f"pip install {' '.join(lacking)}")
    return ok(", ".join(f"{p} {_version(p)}" for p in rows_of(PACKAGES)["needed"].values()))


def _version(package: str) -> str:
    for name in CV2 if package in CV2 else (package,):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "(version not told)"


def compiled() -> Finding:
    """The compiled modules."""
    if find_spec("starpos._numeric.roots") is None:
        return missing(
            "the modules in Cython are not compiled",
            "pip install ./src/starpos, or make build in a clone (a C compiler is needed)",
        )
    return ok("the modules in Cython are compiled")


def optional() -> Finding:
    """The packages that some work needs."""
    lacking = {
        package: use
        for module, (package, use) in rows_of(PACKAGES)["optional"].items()
        if find_spec(module) is None
    }
    if not lacking:
        return ok("all optional packages are here")
    uses = "; ".join(f"{package} ({use})" for package, use in lacking.items())
    return note(f"not here: {uses}", f"pip install {' '.join(lacking)}")


def star_catalogue() -> Finding:
    """The catalogue of stars in use, and the deeper one."""
    from starpos.sky import catalogue, deeper

    stars = catalogue.load_catalogue()
    where = os.environ.get("STARPOS_CATALOGUE") or "the one that comes with starpos"
    found = f"{len(stars)} stars to V = {stars.vmag().max():.1f}, {where}"
    if deeper.kept() is None:
        found += "; no deeper one, which fields under about 1 deg need (docs/how-to/small_fields.md)"
    return ok(found)


def cache() -> Finding:
    """The folder where tables are kept that are built once."""
    from starpos.table_cache import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return missing(
            f"{folder}: cannot be written ({error.strerror}): each start sorts the sky again",
            "export XDG_CACHE_HOME=FOLDER",
        )
    megabytes = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6
    kept = (
        f"{megabytes:.0f} MB kept"
        if megabytes >= 1
        else "empty: the first frame of a camera takes some seconds"
    )
    return ok(f"{folder}, {kept}")


def earth_rotation() -> Finding:
    """The age of the IERS table against now."""
    from starpos.earth import orientation
    from starpos.units import utc_text

    now = time.time()
    until = orientation.measured_until()
    beyond = orientation.earth_orientation(now).extrapolated_days
    found = f"IERS table, measured until {utc_text(until)[:10]}, {(now - until) / DAY_S:.0f} days ago"
    if beyond <= 0:
        return ok(found)
    sigma_m = orientation.earth_orientation(now).ut1_sigma_s * orientation.EQUATOR_M_PER_S
    return note(
        f"{found}: its predictions ended {beyond:.0f} days ago, an error of {sigma_m:.0f} m east at the equator",
        "pip install --upgrade astropy-iers-data",
    )


def clock() -> Finding:
    """The kernel's state of this machine's clock."""
    from starpos import system_clock

    state = system_clock.read()
    if state is None:
        return note("the system does not report whether it is kept to UTC")
    if state.synchronised:
        return ok(f"kept to UTC within {state.max_error_s:.2g} s; 1 s is 464 m at the equator")
    return note(
        "nothing keeps it to UTC: frames stamped on this machine give no longitude; recorded ones are not "
        "affected",
        "sudo apt-get install chrony   # or: sudo timedatectl set-ntp true",
    )


def serial_ports(root: Path = Path("/")) -> Finding:
    """Serial ports, for an inclinometer."""
    found = {os.path.realpath(path): path for pattern in reversed(SERIAL) for path in root.glob(pattern)}
    if not found:
        return note("none: no inclinometer is plugged in")
    return _devices([str(path) for path in found.values()], "dialout")


def cameras(root: Path = Path("/")) -> Finding:
    """Video devices, and photo cameras on USB."""
    videos = sorted(root.glob("dev/video*"))
    photo = sorted(
        _text(interface.parents[1] / "product") or interface.parents[1].name
        for interface in root.glob("sys/bus/usb/devices/*/*/bInterfaceClass")
        if _text(interface) == STILL_IMAGE
    )
    if not videos and not photo:
        return note("no video device and no photo camera on USB; a camera on the network is not looked for")
    names = [f"{v} ({_text(root / 'sys/class/video4linux' / v.name / 'name') or 'no name'})" for v in videos]
    finding = _devices([str(v) for v in videos], "video", [*names, *(f"{p} (photo, USB)" for p in photo)])
    if photo and find_spec("gphoto2") is None and finding.state is State.OK:
        return note(f"{finding.found}; photo cameras need gphoto2", "pip install gphoto2")
    return finding


def _devices(paths: list[str], group: str, names: list[str] | None = None) -> Finding:
    """Devices, and whether this user may open them."""
    barred = [path for path in paths if not os.access(path, os.R_OK | os.W_OK)]
    found = ", ".join(names or paths)
    if not barred:
        return ok(found)
    return note(
        f"{found}; this user may not open {', '.join(barred)}",
        f"sudo usermod -aG {group} $USER   # and log in again",
    )


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES).decode(errors="replace").strip()
    except OSError:
        return ""


def ros() -> Finding:
    """ROS 2 and the packages of the nodes."""
    distribution = os.environ.get("ROS_DISTRO", "")
    if find_spec("rclpy") is None:
        return note("not in this shell; the command line does not need it")
    nodes = [name for name in ("starpos_camera", "starpos_inclinometer", "starpos_solver") if find_spec(name)]
    if len(nodes) == 3:
        return ok(f"{distribution or 'rclpy'}, and the nodes of starpos")
    return note(
        f"{distribution or 'rclpy'}, but the nodes of starpos are not in this shell",
        ". install/setup.bash   # in the workspace that was built",
    )


CHECKS: dict[str, Callable[[], Finding]] = {
    "starpos": versions,
    "packages": packages,
    "compiled modules": compiled,
    "optional": optional,
    "star catalogue": star_catalogue,
    "cache": cache,
    "Earth rotation": earth_rotation,
    "clock": clock,
    "serial ports": serial_ports,
    "cameras": cameras,
    "ROS 2": ros,
}
# checks that only an instrument on this machine needs
LIVE = ("clock", "serial ports", "cameras")
