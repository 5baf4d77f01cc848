# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `dashboard`."""

from starpos_common.parameters import Form, Parameter

# An empty address would silently mean every network of this machine.
ADDRESS = Form(
    "an address of this machine, such as 127.0.0.1, without blanks", lambda text: text.split() == [text]
)

PARAMETERS = (
    Parameter(
        "address",
        "127.0.0.1",
        "Address that the page is served on; 0.0.0.0 and :: are all networks of this machine. Everyone who "
        "reaches it sees where the instrument is, without a password.",
        read_only=True,
        form=ADDRESS,
    ),
    Parameter(
        "port",
        8042,
        "Port that the page is served on; 0 takes a free one and logs it.",
        unit="",
        minimum=0,
        maximum=65535,
        read_only=True,
    ),
    Parameter(
        "hosts",
        "",
        "Names under which browsers may ask for the page, separated by commas, besides localhost, this machine's own "
        "name and plain addresses. Any other name is refused: it would let a foreign page read this one (DNS rebinding).",
        read_only=True,
    ),
    Parameter(
        "clients",
        8,
        "Maximum number of open pages; each takes a connection.",
        unit="",
        minimum=1,
        maximum=64,
    ),
    Parameter(
        "rate",
        5.0,
        "How often an open page gets new values. A high rate takes CPU time here and on the phone.",
        unit="Hz",
        minimum=1.0,
        maximum=20.0,
    ),
    Parameter(
        "stale_after",
        15.0,
        "Age at which fix, heading and frame are shown as old. Make it longer than the cadence of "
        "the camera, or they are old between any two frames. Tilt and diagnostics are old after 5 "
        "s, or earlier if this is shorter.",
        unit="s",
        minimum=1.0,
        maximum=86400.0,
    ),
    Parameter(
        "track",
        1000,
        "Number of newest fixes drawn on the map. Many slow down the browser.",
        unit="",
        minimum=1,
        maximum=10000,
    ),
    Parameter(
        "image_side",
        1280,
        "Longest side of the annotated frame that is shown. Large frames load the network.",
        unit="px",
        minimum=64,
        maximum=4096,
    ),
    Parameter(
        "image_rate",
        1.0,
        "Maximum number of frames per second that are shown.",
        unit="Hz",
        minimum=0.01,
        maximum=10.0,
    ),
    Parameter(
        "lights",
        "camera, detector, inclinometer, solver",
        "Nodes whose diagnostics are shown, separated by commas; a node that sends none is named. "
        "Give names in the dashboard's own namespace, or whole names such as /b/solver. '' shows "
        "the diagnostics of all nodes.",
    ),
)


def names(text: str) -> frozenset[str]:
    """Split a list separated by commas into its words."""
    return frozenset(word.strip() for word in text.split(",") if word.strip())
