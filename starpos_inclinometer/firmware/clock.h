// SPDX-License-Identifier: Apache-2.0
// Time since the reset, from timer 1.
#pragma once

#include <stdint.h>

void clock_init(void);
uint32_t clock_ms(void);
