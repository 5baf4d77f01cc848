# SPDX-License-Identifier: Apache-2.0
"""The node `dashboard`: a read-only web page of the running instrument."""
