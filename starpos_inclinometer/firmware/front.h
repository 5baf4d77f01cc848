// SPDX-License-Identifier: Apache-2.0
// What measures X, Y and the temperature: front_ad7730.c of one board, front_scl3300.c of the other.
// A burst is what it measures within a window of 20 ms; a sample is the mean of its bursts.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

// The F field of `T`.
#define NO_ANSWER 0x01
#define MEANINGLESS 0x02
#define NO_TEMPERATURE 0x04
#define FIRST 0x08
#define WATCHDOG 0x10
#define OVERRUN 0x20
#define UPSIDE_DOWN 0x40
#define SELF_TEST 0x80

#define CODE_ZERO 0x800000UL
#define WINDOW_MS 20 // of a burst: the period of the highest rate

// From the window's tick to the middle of the burst, and the time that setting up takes.
extern const uint8_t front_half_burst_ms;
extern const uint16_t front_setup_ms;
extern const uint8_t front_readings; // of X, and of Y, in a burst
// Of the readings of a sample, as codes: 24 bits, offset binary. Meaningless once a burst ends with NO_ANSWER.
extern uint32_t front_sums[2];

void front_begin_setup(uint32_t now);    // the SPI bus is there
void front_poll(uint32_t now);
bool front_pending(void);                // poll has something to do now
void front_begin_burst(void);
uint8_t front_end_burst(uint32_t now);   // at the window's end; status bits
void front_abandon(void);                // the burst under way
bool front_idle(void);                   // it is set up, and a burst may begin at once
bool front_temperature(uint8_t *counts); // the T field; false where it means nothing
