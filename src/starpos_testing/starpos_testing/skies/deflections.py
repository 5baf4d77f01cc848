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
    tide, curvature = [0.01, -0.02], 0.1
    mark = [xi + curvature, eta]
    frames = [
        {
            "file": f"{k}.csv", "status": "ok", "utc": f"2026-03-01T20:{k:02d}:00.000Z", "face": 1 + k // 3,
            "heading": 90.0 * (k // 3), "xi_arcsec": mark[0] + 0.1 * (-1) ** k, "eta_arcsec": mark[1] - 0.1 * (-1) ** k,
            "sigma_xi_arcsec": 0.1, "sigma_eta_arcsec": 0.1,
        }
        for k in range(12)
    ]  # fmt: skip
    whole = {
        "combined": True, "status": "ok", "station": station, "utc": "2026-03-01T20:06:00.000Z", "duration_s": 660.0,
        "site": {"latitude": latitude, "longitude": longitude, "height_m": height_m},
        "xi_arcsec": mark[0] + tide[0], "eta_arcsec": mark[1] + tide[1],
        "covariance_arcsec2": [[variance, both], [both, variance]], "faces": 4, "frames": 12,
        "errors": {"image motion": [new, new], "catalogue": [common, common]}, "image_motion_arcsec": 0.3, "stars": 40,
        "correlations": {"image motion": 0.0, "catalogue": correlation},
        "reduced": {
            "tide_arcsec": tide, "curvature_arcsec": [curvature, 0.0], "mark_arcsec": mark, "geoid_arcsec": [xi, eta],
        },
        "by_face": [
            {"face": k + 1, "heading": 90.0 * k, "frames": 3, "off_arcsec": [0.05, -0.04], "stddev_arcsec": [0.1, None],
             "chi2": 0.4}
            for k in range(4)
        ],
    }  # fmt: skip
    path.write_text("".join(json.dumps(line) + "\n" for line in (*frames, whole)))
    return path
