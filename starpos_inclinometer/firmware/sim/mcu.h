// SPDX-License-Identifier: Apache-2.0
// The ATmega8 and what is on its pins.
#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "adc.h"
#include "sensor.h"

#define MCU_HZ 8000000

struct mcu {
    struct sensor sensor;
    struct adc adc;
    void (*sent)(char byte); // by the UART
    double reset_at;         // s
    double line_at;          // s of the last '$' sent
    double asleep;           // s altogether
    unsigned hang_at;        // bytes to come of a write to the converter; 0: not
};

extern struct mcu mcu;

bool mcu_init(const char *elf, uint32_t unit); // false: no such firmware
double mcu_now(void);                          // s since power-on, of the MCU's crystal
bool mcu_run(double until);                    // false: it crashed
void mcu_reset(bool power);                    // by its pin, or all of the board by its power
void mcu_hang(void);                           // an endless loop with interrupts off, as a fault would leave it
size_t mcu_receive(const char *bytes, size_t count); // at the UART; how many it takes now
