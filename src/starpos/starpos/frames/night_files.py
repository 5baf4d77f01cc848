# SPDX-License-Identifier: Apache-2.0
"""Names of what lies beside the frames of a night on the disk."""

# readings of the inclinometer; fixes of a GNSS receiver; what is known to be true of the night
TILTS, GNSS, TRUTH = "tilt.csv", "gnss.csv", "truth.json"
# in truth.json, of a simulated night: its other files, each with the digest of what was written
SIMULATED = "simulated_files"
