// SPDX-License-Identifier: Apache-2.0
// The MCU of either board and what is on its pins.
#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "adc.h"
#include "scl3300.h"
#include "sensor.h"

enum board { PAPER, NANO };

struct mcu {
    struct sensor sensor;
    struct adc adc;         // of the board PAPER
    struct scl3300 scl3300; // of the board NANO
    void (*sent)(char byte); // by the UART
    double reset_at;         // s
    double line_at;          // s of the last '$' sent
    double asleep;           // s altogether
    unsigned hang_at;        // bytes to come of a write to the converter; 0: not
};

extern struct mcu mcu;

bool mcu_init(const char *elf, enum board board, uint32_t unit); // false: no such firmware
double mcu_now(void);                          // s since power-on, of the MCU's crystal
bool mcu_run(double until);                    // false: it crashed
void mcu_reset(bool power);                    // by its pin, or all of the board by its power
void mcu_shutter(double after_s, double seconds, unsigned bounces); // closes after a time, bounces, opens
void mcu_pps(double after_s, double every_s);                       // pulses of a receiver from then on; 0: no more
void mcu_hang(void);                           // an endless loop with interrupts off, as a fault would leave it
size_t mcu_receive(const char *bytes, size_t count); // at the UART; how many it takes now
