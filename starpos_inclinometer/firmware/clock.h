// SPDX-License-Identifier: Apache-2.0
// Time since the reset, from timer 1.
#pragma once

#include <stdint.h>

struct instant {
    uint32_t ms;
    uint16_t us; // 0 to 999
};

void clock_init(void);
uint32_t clock_ms(void);
struct instant clock_instant(uint16_t timer); // of timer 1's count a moment ago, with interrupts off
