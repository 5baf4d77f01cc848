# SPDX-License-Identifier: Apache-2.0
"""Many fixes of one place as one."""
