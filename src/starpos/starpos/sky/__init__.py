# SPDX-License-Identifier: Apache-2.0
"""The sky: the star catalogue, and where its stars stand above a place."""
