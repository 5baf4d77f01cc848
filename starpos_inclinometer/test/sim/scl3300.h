// SPDX-License-Identifier: Apache-2.0
// The SCL3300-D01: its SPI frames, its start-up, modes, status and self-test.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "sensor.h"

struct scl3300 {
    uint8_t in[4], count; // the frame under way
    uint8_t out[4];       // the answer to the frame before
    bool selected;
    double deselected_at;
    double powered_at, reset_at, settled_at; // s
    uint16_t mode, status;
    bool angles_on;
    bool upside_down, broken, noisy; // the board lies on its face; MISO is cut; one bit of each third frame is wrong
    int16_t self_test;               // its output
    unsigned frames, resets;
};

void scl3300_power_on(struct scl3300 *s, double now);
void scl3300_fail(struct scl3300 *s, uint16_t status); // status bits that its own supervision sets
void scl3300_select(struct scl3300 *s, bool selected, struct sensor *feels, double now);
uint8_t scl3300_transfer(struct scl3300 *s, uint8_t in, double now);
