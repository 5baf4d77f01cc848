// SPDX-License-Identifier: Apache-2.0
// The board: clocks, pins, and the analog front end the codes depend on. The wiring table is in the package's README.
#pragma once

#include <avr/io.h>

#ifndef F_CPU
#define F_CPU 8000000UL // crystal
#endif
#define AD7730_CLOCK_HZ 4915200UL // crystal at MCLK

// SPI: PB3 MOSI, PB4 MISO, PB5 SCK. PB2 is SS, which must be an output while the MCU is the master.
#define PIN_AD7730_CS PB2
#define PIN_SCA100T_CS PB1
#define PIN_AD7730_RDY PD2 // INT0

// The sensor's outputs reach AIN(+) through R1 into R2, whose foot and AIN(-) lie at half the supply. The host's
// `divider` parameter is the ratio; the firmware sends codes and needs neither.
#define DIVIDER_R1_OHM 30000UL
#define DIVIDER_R2_OHM 1000UL
#define DIVIDER_RATIO ((DIVIDER_R1_OHM + DIVIDER_R2_OHM) / DIVIDER_R2_OHM)
#define SENSOR_SWING_MV 2000UL // at 30 deg: 4 V/g sin 30 deg
#define ADC_RANGE_UV 80000UL   // mode register RN = 11
_Static_assert(SENSOR_SWING_MV * 1000 < ADC_RANGE_UV * DIVIDER_RATIO, "30 deg must lie within the ADC's range");
