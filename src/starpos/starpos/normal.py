# SPDX-License-Identifier: Apache-2.0
"""Estimates from medians of normally distributed numbers, which a few outliers do not change."""

import math

# a standard deviation by the median of absolute deviations
SIGMA_PER_MAD = 1.4826
# the median of chi-squared with two degrees of freedom
MEDIAN_OF_CHI2 = 2 * math.log(2)
