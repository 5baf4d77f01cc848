# SPDX-License-Identifier: Apache-2.0
"""Voyages given to a NavigatorSession message by message, as by a node."""

from types import SimpleNamespace

import numpy as np
from voyage_calls import EARTH_M, wrapped

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.parameters.table import defaults_of
from starpos.session.driver import JobsInTurn, Now
from starpos.session.navigator import NavigatorSession, NavigatorSettings

# of an attitude behind its frame, as the solver takes it
LATE_S = 0.5


def header_of(unix_s):
    seconds, microseconds = divmod(round(unix_s * 1e6), 10**6)
    stamp = SimpleNamespace(sec=seconds, nanosec=microseconds * 1000)
    return SimpleNamespace(stamp=stamp, frame_id="camera")


def vector(values):
    return SimpleNamespace(**dict(zip("xyz", map(float, values), strict=True)))


def imu_message(unix_s, gyro, force):
    return SimpleNamespace(
        header=header_of(unix_s),
        angular_velocity=vector(gyro),
        linear_acceleration=vector(force),
        angular_velocity_covariance=[0.0] * 9,
        linear_acceleration_covariance=[0.0] * 9,
    )


def attitude_message(frame):
    seen = frame.camera
    camera_to_gcrs = earth_state(frame.utc_unix_s).gcrs_to_itrs.T @ seen.rotation
    x, y, z, w = rotation.to_quaternion(camera_to_gcrs)
    return SimpleNamespace(
        header=header_of(frame.utc_unix_s),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        covariance=seen.covariance_about_own.ravel(),
        stars_matched=30,
        log_odds=50.0,
        stamp_stddev=0.0,
        clock_stddev=1e-4,
    )


def velocity_message(unix_s, velocity, sigma):
    variance = np.zeros((6, 6))
    variance[[0, 1, 2], [0, 1, 2]] = sigma**2
    twist = SimpleNamespace(twist=SimpleNamespace(linear=vector(velocity)), covariance=variance.ravel())
    return SimpleNamespace(header=header_of(unix_s), twist=twist)


class Told:
    """What a session says of its messages."""

    def __init__(self):
        self.refused, self.said = [], []

    def came(self, name):
        pass

    def refuse(self, name, sentence):
        self.refused.append((name, sentence))

    def info(self, sentence):
        self.said.append(sentence)

    warning = error = info


class Navigator:
    """A session whose jobs are done at once, while it works, and what it has made."""

    def __init__(self, **values):
        values = defaults_of("navigator") | {
            "rate": 2.0,
            "refraction.pressure": 0.0,
            "clock_stddev": 1e-4,
            "vehicle": "rover",
            **values,
        }
        settings = NavigatorSettings(values)
        assert settings.check(values, frozenset(values)) is None
        settings.adopt()
        self.told, self.outputs, self.works = Told(), [], True
        self._jobs = JobsInTurn(self.told.error)
        self.session = NavigatorSession(settings, self._jobs, self.told)

    def play(self, events):
        """Pass (unix_s, take's name, arguments) in the order of time."""
        for unix_s, take, *arguments in sorted(events, key=lambda e: e[0]):
            now = Now(unix_s, unix_s)
            take_it = getattr(self.session, f"receive_{take}")
            self.outputs += take_it(arguments[0], now, *arguments[1:])
            if self.works:
                self._jobs.work()
        return self

    def at(self, unix_s):
        """The output of that time."""
        (output,) = (o for o in self.outputs if abs(o.utc_unix_s - unix_s) < 1e-3)
        return output


def events_of(made, velocity=True, imu=None):
    """The messages of a voyage and when they come; imu: other readings."""
    imu = made.imu if imu is None else imu
    events = [
        (t, "imu", imu_message(t, g, f)) for t, g, f in zip(imu.utc_unix_s, imu.gyro, imu.force, strict=True)
    ]
    events += [(f.utc_unix_s + LATE_S, "attitude", attitude_message(f)) for f in made.frames]
    if velocity:
        log = made.velocity
        rows = zip(log.utc_unix_s, log.velocity, log.sigma, strict=True)
        events += [(t, "velocity", velocity_message(t, v, s), "odom") for t, v, s in rows]
    return events


def off(output, made):
    """East m, north m, heading rad of an output at a frame's time less the truth."""
    fix, k = output.fix, int(np.abs(made.frames_s - output.utc_unix_s).argmin())
    assert abs(made.frames_s[k] - output.utc_unix_s) < 1e-3
    return np.array(
        [
            wrapped(fix.longitude - made.longitude[k]) * EARTH_M * np.cos(made.latitude[k]),
            (fix.latitude - made.latitude[k]) * EARTH_M,
            wrapped(fix.heading - made.heading[k]),
        ]
    )


def output_nees(output, made):
    """Squared error of place and heading in units of the claim; 3 on average."""
    error = off(output, made)
    return float(error @ np.linalg.solve(output.fix.covariance, error))
