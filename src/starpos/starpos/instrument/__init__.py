# SPDX-License-Identifier: Apache-2.0
"""The instrument: its camera, its inclinometer, how they are mounted, and the files that say so."""
