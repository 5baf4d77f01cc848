# SPDX-License-Identifier: Apache-2.0
"""Rules of access: which requests are answered, and how a browser may show the page."""

import ipaddress
import re
import socket

NAME = re.compile(r"\[[0-9a-fA-F:.%]+\]|[A-Za-z0-9._-]+")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def own_names() -> frozenset[str]:
    """The names of this machine."""
    name = socket.gethostname().lower()
    return frozenset({"localhost", name, f"{name}.local"})


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def host_is_known(header: str, names: frozenset[str]) -> bool:
    """Whether a request's Host is a plain address or one of the names.

    A foreign page whose name was changed to lead here (DNS rebinding) sends its own name.
    """
    match = re.fullmatch(rf"({NAME.pattern})(:\d{{1,5}})?", header)
    if not match:
        return False
    name = match[1].strip("[]").lower().rstrip(".")
    try:
        ipaddress.ip_address(name)
        return True
    except ValueError:
        return name in names


def comes_from_elsewhere(site: str | None, mode: str | None) -> bool:
    """Whether another site's page asks, except by a link, judged by a browser's Sec-Fetch-Site and Sec-Fetch-Mode."""
    return site not in (None, "none", "same-origin") and mode != "navigate"
