// SPDX-License-Identifier: Apache-2.0
// Times of the shutter's edges and of a GNSS receiver's pulses: lines `P`.
#pragma once

#include <stdint.h>

void pulses_init(void);
void pulses_poll(uint32_t now); // at least once in each millisecond
