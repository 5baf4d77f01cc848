# SPDX-License-Identifier: Apache-2.0
"""Diagnostic of a source: its health and the flags of its samples as one line of /diagnostics."""

from collections import Counter

from starpos_common.diagnostics import Diagnosis, Level
from starpos_inclinometer.sources.reading import OUT_OF_RANGE, SATURATED, STUCK, Counts, Health, Phase

# Above this share of corrupted or lost lines since the last report the link gets a warning.
BAD_SHARE = 0.05
STEP_SHOWN_S = 30.0
FLAGS = {"stuck": STUCK, "saturated": SATURATED, "out of range": OUT_OF_RANGE}


class Reporter:
    """Makes reports; each counts the samples since the report before."""

    def __init__(self) -> None:
        self._flags: Counter[str] = Counter()
        self._samples = 0
        self._counts = Counts()
        # The flags that are already reported.
        self._known = 0

    def count(self, flags: int) -> bool:
        """Count the flags of a sample; return whether one of them was not reported yet."""
        self._samples += 1
        for name, bit in FLAGS.items():
            self._flags[name] += bool(flags & bit)
        new = flags & (STUCK | SATURATED | OUT_OF_RANGE) & ~self._known
        self._known |= new
        return bool(new)

    def report(self, health: Health, now_s: float) -> Diagnosis:
        """Make the report of a source; now_s is monotonic."""
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
            level, text = Level.WARN, "tilt beyond the sensor's range: set the instrument more upright."
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
