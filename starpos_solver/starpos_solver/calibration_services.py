# SPDX-License-Identifier: Apache-2.0
"""The services `~/calibrate`, `~/self_calibrate` and `~/save_calibration`."""

import math
from pathlib import Path
from typing import TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from starpos.calibration.misalignment import Calibrated
from starpos.errors import InstrumentError, StarposError
from starpos.files import path_of
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.session.session import SolverSession
from starpos.session.settings import Settings
from starpos_interfaces.srv import Calibrate, SaveCalibration, SelfCalibrate


def save_instrument(path: str, calibration_url: str, instrument: Instrument) -> Path:
    """Write an instrument file to `path`, or without one to calibration_url; return its Path.

    Raises InstrumentError if it cannot be written, or if the file there is no instrument file or has a person's comment.
    """
    if not path and not calibration_url:
        raise InstrumentError("there is no file to write: give a path, or set calibration_url")
    if path and not path_of(path).is_absolute():
        raise InstrumentError(
            f"{path}: give a full path, from / on: the node would write it into the folder it was started in"
        )
    where = path_of(path or calibration_url)
    try:
        occupied = where.exists()
    except (OSError, ValueError) as e:
        raise InstrumentError(f"{where}: the file cannot be written there ({e})") from None
    if occupied:
        try:
            instrument_file.check_replaceable(where)
        except InstrumentError as e:
            raise InstrumentError(f"{e}: move it away, or give another path") from None
    instrument_file.write(where, instrument)
    return where


R = TypeVar("R", Calibrate.Response, SelfCalibrate.Response)


class CalibrationServices:
    """Answers the services by the session's calibration."""

    def __init__(self, node: Node, session: SolverSession, settings: Settings) -> None:
        self._session, self._calibrating, self._settings = session, session.calibrating, settings
        # A service that awaits its job must not block the other callbacks.
        group = ReentrantCallbackGroup()
        node.create_service(Calibrate, "~/calibrate", self._on_calibrate, callback_group=group)
        node.create_service(SelfCalibrate, "~/self_calibrate", self._on_self_calibrate, callback_group=group)
        node.create_service(SaveCalibration, "~/save_calibration", self._on_save_calibration)

    async def _on_calibrate(
        self, request: Calibrate.Request, response: Calibrate.Response
    ) -> Calibrate.Response:
        response.misalignment_deg, response.covariance_deg2 = [math.nan] * 3, [math.nan] * 9
        outcome = await self._calibrating.at_known_place(request.latitude, request.longitude, request.frames)
        response.message = outcome.trouble
        if outcome.trouble:
            return response
        response.success, response.message = True, self._calibrating.about
        return _with_a3(response, outcome.value)

    async def _on_self_calibrate(
        self, request: SelfCalibrate.Request, response: SelfCalibrate.Response
    ) -> SelfCalibrate.Response:
        response.misalignment_deg, response.covariance_deg2 = [math.nan] * 3, [math.nan] * 9
        response.latitude = response.longitude = response.plumb_stddev = math.nan
        response.covariance = [math.nan] * 4
        turned, why_not = await self._calibrating.on_the_spot()
        response.success, response.message = not why_not, why_not or self._calibrating.about
        if turned is None:
            return response
        place = turned.place
        response.headings = place.frames
        response.plumb_stddev = turned.calibrated.plumb_stddev_arcsec / 3600
        response.latitude, response.longitude = math.degrees(place.latitude), math.degrees(place.longitude)
        response.covariance = place.covariance[:2, :2].ravel()
        return _with_a3(response, turned.calibrated)

    def _on_save_calibration(
        self, request: SaveCalibration.Request, response: SaveCalibration.Response
    ) -> SaveCalibration.Response:
        url = self._settings.values["calibration_url"]
        try:
            instrument = self._session.instrument.solver_now.instrument
            if self._calibrating.unknown:
                raise InstrumentError("the calibration in use is not known: calibrate first")
            written = save_instrument(request.path, url, instrument)
        except StarposError as e:
            response.message = str(e)
            return response
        # A restart would read this file.
        if written == path_of(url):
            self._settings.saved(instrument)
        response.success, response.message = True, f"{written}: the calibration in use is written"
        return response


def _with_a3(response: R, found: Calibrated) -> R:
    """Fill the calibration into the response of a service."""
    c = found.instrument.calibration
    response.misalignment_deg = list(c.misalignment_deg)
    response.covariance_deg2 = c.angle_covariance_deg2.ravel()
    return response
