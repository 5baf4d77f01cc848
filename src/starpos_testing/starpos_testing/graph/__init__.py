# SPDX-License-Identifier: Apache-2.0
"""The running graph, what an instrument would send it, and two hosts."""
