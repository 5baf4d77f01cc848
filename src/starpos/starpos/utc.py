# SPDX-License-Identifier: Apache-2.0
"""UTC as text and as seconds since 1970."""

import datetime

from starpos.errors import TimeError


def utc_text(utc_unix_s: float) -> str:
    """ISO 8601 with milliseconds, UTC."""
    try:
        moment = datetime.datetime.fromtimestamp(utc_unix_s, datetime.timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{utc_unix_s:g} s after 1970"
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"


def unix_of(utc: str) -> float:
    """Unix seconds of an ISO 8601 time, UTC unless it says otherwise; TimeError if it is none."""
    try:
        moment = datetime.datetime.fromisoformat(utc.replace("Z", "+00:00"))
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=datetime.timezone.utc)
        return moment.astimezone(datetime.timezone.utc).timestamp()
    except (ValueError, OverflowError):  # OverflowError: year 0 or 10000, once its zone is taken off
        raise TimeError(f"{utc!r} is no time: write it like 2026-11-02T18:00:00") from None
