// SPDX-License-Identifier: Apache-2.0
// The converter. Registers, bits and times: AD7730/AD7730L data sheet, Analog Devices, rev. A; tables and pages are its.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "board.h"

// Communications register: what the next transfer is (p. 13), and the register it goes to (table VIII, p. 14).
#define AD7730_WRITE 0x00
#define AD7730_READ 0x10
#define AD7730_STATUS 0x00
#define AD7730_DATA 0x01
#define AD7730_MODE 0x02
#define AD7730_FILTER 0x03

// Status register (table IX, p. 14).
#define AD7730_STATUS_NOREF 0x10 // the reference is below 0.3 V or open (p. 25)

// Mode register, 16 bits (table X, p. 15, and following); 0x01B0 after a reset.
#define AD7730_MODE_IDLE 0x0000           // MD2..MD0 = 000
#define AD7730_MODE_CONTINUOUS 0x2000     // MD = 001
#define AD7730_MODE_ZERO_SCALE 0x8000     // MD = 100: internal zero-scale calibration
#define AD7730_MODE_FULL_SCALE 0xA000     // MD = 101: internal full-scale calibration
#define AD7730_MODE_24_BITS 0x0100        // WL
#define AD7730_MODE_REFERENCE_5V 0x0080   // HIREF
#define AD7730_MODE_RANGE_80MV 0x0030     // RN1, RN0 = 11; bipolar as B/U = 0
#define AD7730_MODE_CHANNEL_1 0x0000      // CH1, CH0: AIN1(+) - AIN1(-)
#define AD7730_MODE_CHANNEL_2 0x0001      // AIN2(+) - AIN2(-)
#define AD7730_MODE_INPUT (AD7730_MODE_24_BITS | AD7730_MODE_REFERENCE_5V | AD7730_MODE_RANGE_80MV)

// Filter register, 24 bits (p. 18, 19); 0x200010 after a reset. Chopping removes the converter's offset and its drift;
// FASTStep gives the first result after a change of channel as the mean of two outputs of the sinc3 filter, which
// are the two halves of the chopping, instead of waiting for the 22 taps of the second filter.
#define AD7730_FILTER_SF_SHIFT 12
#define AD7730_FILTER_FAST 0x000100UL
#define AD7730_FILTER_CHOP 0x000010UL
#define AD7730_SF 150 // chopping without SKIP allows 75 to 2048 (table XV, p. 19)
#define AD7730_FILTER_WORD (((uint32_t)AD7730_SF << AD7730_FILTER_SF_SHIFT) | AD7730_FILTER_FAST | AD7730_FILTER_CHOP)

// Output rate = MCLK / 16 / (3 SF), chopping: 683 Hz.
#define AD7730_PERIOD_NS (3UL * 16 * AD7730_SF * 10000 / (AD7730_CLOCK_HZ / 100000))
#define AD7730_SETTLING_PERIODS 2
// Full-scale and zero-scale calibration take 44 and 22 periods (table XVII, p. 22), each channel its own.
#define AD7730_CALIBRATION_MS (2 * (44 + 22) * AD7730_PERIOD_NS / 1000000 + 1)

void ad7730_init(void);
void ad7730_reset(void);      // 32 ones at DIN; wait a millisecond before the next access
void ad7730_configure(void);  // the filter register; the DAC register adds no offset after a reset (table XVI, p. 20)
void ad7730_start(uint16_t mode); // a calibration, conversions or none: one of the modes, and a channel
bool ad7730_ready(void);          // what was started last has a result
bool ad7730_no_reference(void);
bool ad7730_runs(uint16_t mode); // whether the mode register still holds what ad7730_start put there
uint32_t ad7730_data(void); // 24 bits, offset binary
