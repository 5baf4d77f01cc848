# SPDX-License-Identifier: Apache-2.0
"""The inclinometer: serial line of its microcontroller to tilts with a time and a covariance."""
