// SPDX-License-Identifier: Apache-2.0
#include "clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <stdbool.h>
#include <util/atomic.h>

#include "board.h"

#define CYCLES_PER_MS (F_CPU / 1000)

static volatile uint32_t milliseconds;

ISR(TIMER1_COMPA_vect)
{
    milliseconds++;
}

void clock_init(void)
{
    OCR1A = CYCLES_PER_MS - 1;
    TCCR1B = _BV(WGM12) | _BV(CS10); // clear on compare match, no prescaler
    TIMSK |= _BV(OCIE1A);
}

uint32_t clock_ms(void)
{
    uint32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { now = milliseconds; }
    return now;
}

struct instant clock_instant(uint16_t timer)
{
    // The timer may have wrapped while interrupts were off: then the millisecond is not counted yet.
    bool uncounted = (TIFR & _BV(OCF1A)) && timer < CYCLES_PER_MS / 2;
    uint16_t us = timer / (F_CPU / 1000000);
    return (struct instant){milliseconds + uncounted, us < 1000 ? us : 999};
}
