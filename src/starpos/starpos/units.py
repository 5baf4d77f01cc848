# SPDX-License-Identifier: Apache-2.0
"""Units that are not SI, constants of the normal distribution, and UTC as text and as seconds since 1970."""

import datetime
import math

from starpos.errors import TimeError

ARCSEC = math.radians(1 / 3600)
MAS = ARCSEC / 1000
# A milliarcsecond in degrees.
MAS_DEG = 1 / 3.6e6
DAY_S = 86400.0
HOUR_S = 3600.0


# m/s2; true within 0.3 % everywhere on the ground
STANDARD_GRAVITY = 9.80665
# a standard deviation by the median of absolute deviations
SIGMA_PER_MAD = 1.4826
# the median of chi-squared with two degrees of freedom
MEDIAN_OF_CHI2 = 2 * math.log(2)


UNIX_EPOCH_JD = 2440587.5


def utc_text(utc_unix_s: float) -> str:
    """Unix seconds as ISO 8601 in UTC with milliseconds; in words where no calendar reaches."""
    try:
        moment = datetime.datetime.fromtimestamp(utc_unix_s, datetime.timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{utc_unix_s:g} s after 1970"
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"


def date_obs(utc_unix_s: float) -> str:
    """Unix seconds in the form of FITS' DATE-OBS, UTC to the microsecond."""
    moment = datetime.datetime.fromtimestamp(round(utc_unix_s, 6), datetime.timezone.utc)
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")


def unix_of(utc: str) -> float:
    """Unix seconds of an ISO 8601 time, UTC unless it names another zone; TimeError if it is not a time."""
    try:
        moment = datetime.datetime.fromisoformat(utc.replace("Z", "+00:00"))
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=datetime.timezone.utc)
        return moment.astimezone(datetime.timezone.utc).timestamp()
    # OverflowError: a time whose year is 0 or 10000 in UTC
    except (ValueError, OverflowError):
        raise TimeError(f"{utc!r} is no time: write it like 2026-11-02T18:00:00") from None
