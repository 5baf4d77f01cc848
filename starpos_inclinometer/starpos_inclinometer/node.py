# SPDX-License-Identifier: Apache-2.0
"""The node `inclinometer`: samples from the serial link to `tilt`."""

import math

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time

from starpos_common.diagnostics import Diagnostics, Level, Status
from starpos_common.parameters import Parameter, declare
from starpos_inclinometer import protocol, sensor
from starpos_inclinometer.clock import ArrivalFilter
from starpos_inclinometer.link import Arrival, LinkState, Phase, SerialLink
from starpos_interfaces.msg import Tilt

PARAMETERS = (
    Parameter(
        "port",
        "/dev/ttyUSB0",
        "Serial port; a stable path such as /dev/serial/by-id/... survives replugging, /dev/ttyUSB0 may "
        "become another device.",
        read_only=True,
    ),
    Parameter(
        "baud",
        protocol.BAUD,
        "Speed of the serial line; with a wrong one nothing but garbage comes.",
        "baud",
        1200,
        1_000_000,
        read_only=True,
    ),
    Parameter(
        "frame_id",
        "starpos_inclinometer_frame",
        "Frame of the tilts: S, the sensor's X', Y', Z'.",
        read_only=True,
    ),
    Parameter(
        "rate",
        10,
        "Samples a second from the microcontroller; above 18 Hz, the sensor's bandwidth, they add little.",
        "Hz",
        protocol.MIN_RATE_HZ,
        protocol.MAX_RATE_HZ,
    ),
    Parameter(
        "noise_stddev",
        0.0035,
        "White noise of one sample and axis; too small makes fixes claim more than they hold.",
        "deg",
        1e-6,
        10.0,
    ),
    Parameter(
        "offset_volts",
        (2.5, 2.5),
        "Sensor output of x and y at zero tilt; an error of 1 mV is 52 arcsec of tilt, 1.6 km of position.",
        "V",
        0.0,
        5.5,
    ),
    Parameter(
        "sensitivity",
        (4.0, 4.0),
        "Sensor sensitivity of x and y, 4 for the SCA100T-D01; 0.1 % off is 36 arcsec at 10 deg of tilt.",
        "V/g",
        0.1,
        100.0,
    ),
    Parameter(
        "divider",
        sensor.DIVIDER,
        "Divider between sensor and ADC, (R1 + R2) / R2; 0.1 % off is 36 arcsec at 10 deg of tilt.",
        "",
        1.0,
        1000.0,
    ),
    Parameter(
        "reference_volts",
        sensor.ADC_NOMINAL_REFERENCE_V,
        "Reference of the ADC and supply of the sensor that offset_volts and sensitivity were measured at; "
        "the circuit is ratiometric, so what it is at work does not matter.",
        "V",
        4.5,
        5.5,
    ),
    Parameter(
        "latency",
        math.nan,
        "From the middle of a sample to the first byte of its line; unset takes what the microcontroller "
        "reports. Matters only while the tilt moves.",
        "s",
        0.0,
        10.0,
    ),
)
CALIBRATION = frozenset(("noise_stddev", "offset_volts", "sensitivity", "divider", "reference_volts"))
BITS_PER_BYTE = 10  # 8N1
BAD_SHARE = 0.05  # of lines corrupted or lost since the last report, above which the link is worth a warning


class InclinometerNode(Node):
    """Publishes starpos_interfaces/Tilt on `tilt`; see README.md."""

    def __init__(self):
        super().__init__("inclinometer")
        self._values = declare(self, PARAMETERS, apply=self._apply)
        self._sensor = sensor.Sensor(self._calibration())
        self._arrivals = ArrivalFilter()
        self._publisher = self.create_publisher(
            Tilt,
            "tilt",
            QoSProfile(depth=100),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._logged: tuple[Phase, str] | None = None
        self._flags = 0  # of all samples since the last report
        self._reported = protocol.Counts()
        self._wake = self.create_guard_condition(self._on_wake)
        self._link = SerialLink(
            self._values["port"],
            self._values["rate"],
            lambda: self.get_clock().now().nanoseconds,
            self._wake.trigger,
            self._values["baud"],
        )
        self._diagnostics = Diagnostics(self, {"Link": self._report}, self._values["port"])
        self._link.start()

    def destroy_node(self):
        self._link.stop()
        super().destroy_node()

    def _calibration(self) -> sensor.Calibration:
        v = self._values
        return sensor.Calibration(
            v["offset_volts"],
            v["sensitivity"],
            v["divider"],
            v["reference_volts"],
            math.radians(v["noise_stddev"]),
        )

    def _apply(self, names: frozenset[str]):
        if names & CALIBRATION:
            self._sensor.calibration = self._calibration()
        if "rate" in names:
            self._link.set_rate(self._values["rate"])

    def _on_wake(self):
        state = self._link.state()
        latency = self._latency(state)
        for arrival in self._link.take():
            self._publish(arrival, latency)
        if (state.phase, state.sentence) != self._logged:
            self._logged = (state.phase, state.sentence)
            # rclpy ties a severity to the line it is called from, so each has its own.
            if state.phase is Phase.RECEIVING:
                self.get_logger().info(state.sentence)
            else:
                self.get_logger().warning(state.sentence)

    def _latency(self, state: LinkState) -> float:
        """Seconds from a sample to the end of its line, at the quickest."""
        latency = self._values["latency"]
        if math.isnan(latency):
            latency = state.identity.delay_ms * 1e-3 if state.identity else 0.0
        return latency + protocol.SAMPLE_LINE * BITS_PER_BYTE / self._values["baud"]

    def _publish(self, arrival: Arrival, latency: float):
        sample = arrival.sample
        if sample.restarted or sample.resumed:
            self._arrivals.restart()
        late = self._arrivals.delay(sample.milliseconds, arrival.monotonic_s)
        reading = self._sensor.measure(sample)
        self._flags |= reading.flags
        message = Tilt()
        stamp_ns = max(arrival.caller_ns - round((late + latency) * 1e9), 0)
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        message.header.frame_id = self._values["frame_id"]
        message.x = reading.x
        message.y = reading.y
        message.covariance = [reading.variance_x, 0.0, 0.0, reading.variance_y]
        message.temperature = reading.temperature_c
        message.sequence = sample.sequence
        message.flags = reading.flags
        self._publisher.publish(message)

    def _report(self) -> Status:
        state = self._link.state()
        counts, before = state.counts, self._reported
        self._reported = counts
        flags, self._flags = self._flags, 0
        good = counts.good - before.good
        bad = counts.crc_errors - before.crc_errors + counts.lost - before.lost
        level, text = Level.OK, state.sentence
        if state.phase is not Phase.RECEIVING:
            level = Level.ERROR
        elif flags & sensor.STUCK:
            level, text = (
                Level.ERROR,
                "the converter is stuck: the same codes again and again; check its wiring.",
            )
        elif flags & (sensor.SATURATED | sensor.OUT_OF_RANGE):
            level, text = Level.WARN, "tilt beyond +-30 deg: set the instrument more upright."
        elif state.refused:
            level, text = (
                Level.WARN,
                f"the microcontroller refused {self._values['rate']} Hz: set another `rate`.",
            )
        elif bad > BAD_SHARE * (good + bad):
            level, text = (
                Level.WARN,
                f"{bad} of {good + bad} lines were corrupted or lost: check cable and grounding.",
            )
        identity = state.identity
        values = {
            "port": self._values["port"],
            "phase": state.phase.value,
            "rate (Hz)": state.rate_hz,
            "good lines": counts.good,
            "checksum errors": counts.crc_errors,
            "malformed lines": counts.malformed,
            "garbage bytes": counts.garbage_bytes,
            "lost samples": counts.lost,
            "doubled samples": counts.duplicates,
            "unfetched samples": state.dropped,
            "microcontroller resets": counts.restarts,
            "openings": state.connections,
            "clock rate error (ppm)": self._arrivals.rate_ppm,
            "firmware": f"{identity.firmware >> 8}.{identity.firmware & 255}" if identity else "unknown",
            "unit": f"{identity.unit:08X}" if identity else "unknown",
        }
        return Status(level, text, values)
