// SPDX-License-Identifier: Apache-2.0
// The digital inclinometer: Murata SCL3300-D01, Doc. 4921 Rev. 2; tables and sections are its.
#pragma once

#include <stdbool.h>
#include <stdint.h>

// Operations (table 15): read or write, and the register; the low 16 bits are the data of a write.
#define SCL3300_READ(address) ((uint32_t)(address) << 26)
#define SCL3300_WRITE(address, data) (0x80000000UL | (uint32_t)(address) << 26 | (uint32_t)(data) << 8)

#define SCL3300_SELF_TEST_OUTPUT 0x04
#define SCL3300_TEMPERATURE 0x05
#define SCL3300_STATUS 0x06
#define SCL3300_ANGLE_X 0x09
#define SCL3300_ANGLE_Y 0x0A
#define SCL3300_ANGLE_Z 0x0B
#define SCL3300_ANGLE_CONTROL 0x0C
#define SCL3300_MODE 0x0D
#define SCL3300_WHOAMI 0x10

#define SCL3300_MODE_1 0x00 // 1.8 g, 40 Hz: the one that measures at any lean
#define SCL3300_SOFTWARE_RESET 0x20
#define SCL3300_ANGLES_ON 0x1F
#define SCL3300_IDENTITY 0xC1

// Start-up (table 11): after the supply, after the reset, until the signal path has settled in mode 1.
#define SCL3300_POWER_MS 10
#define SCL3300_RESET_MS 2
#define SCL3300_SETTLING_MS 26
#define SCL3300_QUARTER_TURN 16384     // an angle of 90 deg
#define SCL3300_SELF_TEST_LIMIT 1800   // of its output in mode 1 (section 2.4)

enum scl3300_answer {
    SCL3300_GOOD,
    SCL3300_WRONG,   // the CRC or the register: a broken line, or no sensor
    SCL3300_FAILING, // the return status is an error, or it is starting up
};

// Sends a frame; what comes back answers the one before (section 5.1.3), which *answer becomes of.
enum scl3300_answer scl3300_frame(uint32_t operation, uint16_t *answer);
