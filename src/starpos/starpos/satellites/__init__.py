# SPDX-License-Identifier: Apache-2.0
"""A place from satellites seen among the stars, without a level."""
