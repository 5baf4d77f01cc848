# SPDX-License-Identifier: Apache-2.0
"""The hot loops, compiled (Cython): each has its caller, who checks what comes in, and a plain form as oracle in a test.

Arrays come and go as plain numbers through Python's buffer protocol: one build serves any numpy. A module is a topic.
"""
