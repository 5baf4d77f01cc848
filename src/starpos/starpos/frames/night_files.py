# SPDX-License-Identifier: Apache-2.0
"""Names of the files next to the frames of a night on disk."""

# readings of the inclinometer; fixes of a GNSS receiver; what is known to be true of the night
TILTS, GNSS, TRUTH = "tilt.csv", "gnss.csv", "truth.json"
# in truth.json, of a simulated night: its other files, each with the digest of what was written
SIMULATED = "simulated_files"
