// SPDX-License-Identifier: Apache-2.0
// The AD7730: its registers and serial interface, the times of its filter and calibrations, its RDY output.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "sensor.h"

struct adc {
    uint8_t address, left, ones; // serial interface: register, bytes of it to come, consecutive ones at DIN
    bool reading;
    uint32_t shift;
    uint16_t mode;
    uint32_t filter;
    uint8_t dac;
    uint32_t data;
    bool ready, no_reference;
    bool full_scale[2], zero_scale[2]; // calibrated since the reset
    double began, next;                // of what is under way, s; next is 0 where nothing is
    double pulse;                      // s when RDY falls again after an update nobody read; 0: none
    bool frozen, reference_missing;
    unsigned slips_after; // bytes, a spike on SCLK: the interface takes one more than it is given; 0: none
    bool slipped;         // or its transfer cut short; until a reset
    unsigned resets, conversions;
};

void adc_power_on(struct adc *a);
void adc_interrupt(struct adc *a); // its master forgot the transfer: what it sends next ends that one
uint8_t adc_transfer(struct adc *a, uint8_t in, double now);
double adc_next_event(const struct adc *a); // s; 0: none
void adc_event(struct adc *a, struct sensor *s, double now);
