# SPDX-License-Identifier: Apache-2.0
"""Results of sessions as `starpos deflection --json` prints them, with values that a test chooses."""

import json

NEW_ARCSEC, COMMON_ARCSEC = 0.06, 0.03


def result(
    path,
    latitude,
    longitude,
    xi,
    eta,
    *,
    station="",
    height_m=500.0,
    new=NEW_ARCSEC,
    common=COMMON_ARCSEC,
    correlation=0.0,
):
    """Write a session's result: tide free xi, eta at the geoid (arcsec), errors of two sources; the file's path."""
    variance, both = new**2 + common**2, correlation * common**2
    mark = [xi + 0.1, eta]
    whole = {
        "combined": True, "status": "ok", "station": station, "utc": "2026-03-01T20:06:00.000Z",
        "site": {"latitude": latitude, "longitude": longitude, "height_m": height_m},
        "xi_arcsec": mark[0] + 0.01, "eta_arcsec": mark[1] - 0.02,
        "covariance_arcsec2": [[variance, both], [both, variance]], "frames": 12,
        "errors": {"image motion": [new, new], "catalogue": [common, common]},
        "correlations": {"image motion": 0.0, "catalogue": correlation},
        "reduced": {"mark_arcsec": mark, "geoid_arcsec": [xi, eta]},
    }  # fmt: skip
    path.write_text(json.dumps(whole) + "\n")
    return path
