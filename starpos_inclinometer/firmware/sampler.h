// SPDX-License-Identifier: Apache-2.0
// Takes samples at the rate asked for and sends them.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define SAMPLER_MIN_HZ 1
#define SAMPLER_MAX_HZ 50
#define SAMPLER_DEFAULT_HZ 10

void sampler_init(bool after_watchdog);
void sampler_poll(void);                // whenever a millisecond has passed or the converter is ready
void sampler_set_rate(uint8_t rate_hz); // MIN to MAX; a new rate abandons the sample under way
uint8_t sampler_rate_hz(void);
uint16_t sampler_delay_ms(void); // from the middle of a sample's conversions to the first byte of its line
