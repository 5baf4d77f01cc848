# SPDX-License-Identifier: Apache-2.0
"""A source's health and the flags of its samples as one line of /diagnostics."""

from collections import Counter

from starpos_common.diagnostics import Diagnosis, Level
from starpos_inclinometer.sources.reading import OUT_OF_RANGE, SATURATED, STUCK, Counts, Health, Phase

BAD_SHARE = 0.05  # of lines corrupted or lost since the last report, above which the link is worth a warning
STEP_SHOWN_S = 30.0
FLAGS = {"stuck": STUCK, "saturated": SATURATED, "out of range": OUT_OF_RANGE}


class Reporter:
    """Makes reports; each counts what has come since the one before."""

    def __init__(self):
        self._flags = Counter()
        self._samples = 0
        self._counts = Counts()
        self._known = 0  # flags the last report told of

    def count(self, flags: int) -> bool:
        """A sample's flags; whether one is set that the last report did not tell of."""
        self._samples += 1
        for name, bit in FLAGS.items():
            self._flags[name] += bool(flags & bit)
        new = flags & (STUCK | SATURATED | OUT_OF_RANGE) & ~self._known
        self._known |= new
        return bool(new)

    def report(self, health: Health, now_s: float) -> Diagnosis:
        """now_s: monotonic."""
        counts, before, self._counts = health.counts, self._counts, health.counts
        flags, self._flags = self._flags, Counter()
        samples, self._samples = self._samples, 0
        self._known = sum(bit for name, bit in FLAGS.items() if flags[name])
        good = counts.good - before.good
        bad = sum(
            getattr(counts, name) - getattr(before, name)
            for name in ("crc_errors", "malformed", "lost", "implausible")
        )
        level, text = Level.OK, health.sentence
        step = health.step
        if health.phase is not Phase.RECEIVING:
            level = Level.WARN if health.phase is Phase.MOVING else Level.ERROR
        elif flags["stuck"]:
            level = Level.ERROR
            text = (
                "the sensor is stuck: the same values again and again; check its wiring, clock and reference."
            )
        elif flags["saturated"] or flags["out of range"]:
            level, text = Level.WARN, "tilt beyond +-30 deg: set the instrument more upright."
        elif health.complaint:
            level, text = Level.WARN, health.complaint
        elif step and now_s - step.monotonic_s < STEP_SHOWN_S:
            level, text = Level.WARN, step_sentence(step.seconds)
        elif bad > BAD_SHARE * (good + bad):
            level = Level.WARN
            text = f"{bad} of {good + bad} lines were corrupted or lost: check cable and grounding."
        values = {
            "phase": health.phase.value,
            "rate (Hz)": health.rate_hz,
            "samples since the last report": samples,
            **{f"of these {name}": flags[name] for name in FLAGS},
            "good lines": counts.good,
            "checksum errors": counts.crc_errors,
            "malformed lines": counts.malformed,
            "garbage bytes": counts.garbage_bytes,
            "lost samples": counts.lost,
            "doubled samples": counts.duplicates,
            "implausible samples": counts.implausible,
            "device resets": counts.restarts,
            **health.values,
        }
        return Diagnosis(level, text, values)


def step_sentence(seconds: float) -> str:
    return f"the host's clock was stepped by {seconds:+.3f} s: stamps are of the new time from there on."
