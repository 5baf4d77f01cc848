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
        "Address the page is served on; 0.0.0.0 or :: is every network of this machine, and whoever reaches it reads "
        "where the instrument is, without a password.",
        read_only=True,
        form=ADDRESS,
    ),
    Parameter(
        "port",
        8042,
        "Port the page is served on; 0 takes any free one, which the log names.",
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
        "Pages that may be open at once; each costs a connection.",
        unit="",
        minimum=1,
        maximum=64,
    ),
    Parameter(
        "rate",
        5.0,
        "How often an open page gets new values; often costs CPU here and on the phone.",
        unit="Hz",
        minimum=1.0,
        maximum=20.0,
    ),
    Parameter(
        "stale_after",
        15.0,
        "Age at which fix, heading and frame are shown as old; longer than the cadence of the camera, else they are old "
        "between any two frames. Tilt and diagnostics are old after 5 s, or this where it is shorter.",
        unit="s",
        minimum=1.0,
        maximum=86400.0,
    ),
    Parameter(
        "track",
        1000,
        "Newest fixes drawn on the map; many cost the browser time.",
        unit="",
        minimum=1,
        maximum=10000,
    ),
    Parameter(
        "image_side",
        1280,
        "Longest side of the annotated frame as it is shown; large ones cost the network.",
        unit="px",
        minimum=64,
        maximum=4096,
    ),
    Parameter(
        "image_rate", 1.0, "Most frames a second that are shown.", unit="Hz", minimum=0.01, maximum=10.0
    ),
    Parameter(
        "lights",
        "camera, detector, inclinometer, solver",
        "Nodes whose diagnostics are shown, separated by commas, and named where they say nothing: those of the "
        "dashboard's own namespace, or by whole names such as /b/solver; '' shows those of every node there is.",
    ),
)


def names(text: str) -> frozenset[str]:
    """Split a list separated by commas into its words."""
    return frozenset(word.strip() for word in text.split(",") if word.strip())
