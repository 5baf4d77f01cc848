# SPDX-License-Identifier: Apache-2.0
"""What the compiled modules of several rooms share: linear algebra, limits, memory, vectors as wide as registers, roots.

A compiled module (Cython) stands next to the Python that calls it, `detection/_peaks.pyx` for one. Arrays come and go as
plain numbers through Python's buffer protocol: one build serves any numpy. A plain form of each is the oracle in a test.
"""
