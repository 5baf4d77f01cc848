// SPDX-License-Identifier: Apache-2.0
// The shutter's contact (or a camera's strobe line) is on the input capture of timer 1, which keeps the count of each
// edge; the receiver's pulse is on INT1, whose handler reads the count. A contact bounces: of its edges those after 2 ms of
// rest are told, with how many followed each.
#include "pulses.h"

#include <avr/interrupt.h>
#include <stdbool.h>
#include <util/atomic.h>

#include "board.h"
#include "clock.h"
#include "frame.h"

#define REST_MS 2
#define RISING 0x80 // of the K field
enum input { SHUTTER, PPS, INPUTS };

struct pulse {
    uint8_t kind, number, bounces;
    struct instant at;
};

#define QUEUE 4
static struct pulse queue[QUEUE];
static volatile uint8_t waiting;

// Those of an input that count on although the queue is full.
static uint8_t numbers[INPUTS];
static uint8_t bounces;   // of the shutter since its last edge that was told
static uint32_t moved_ms; // when it last moved

// Interrupts are off in all of these.

static void told(enum input input, bool rising, struct instant at)
{
    uint8_t number = numbers[input]++, before = bounces;
    if (input == SHUTTER)
        bounces = 0;
    if (waiting == QUEUE)
        return;
    queue[waiting++] = (struct pulse){input | (rising ? RISING : 0), number, input == SHUTTER ? before : 0, at};
}

static void bounced(void)
{
    if (bounces < UINT8_MAX)
        bounces++;
}

// Waits for the edge that must come next.
static void follow_level(void)
{
    if (PINB & _BV(PIN_SHUTTER))
        TCCR1B &= ~_BV(ICES1);
    else
        TCCR1B |= _BV(ICES1);
}

ISR(TIMER1_CAPT_vect)
{
    struct instant at = clock_instant(ICR1);
    bool rising = TCCR1B & _BV(ICES1);
    if (at.ms - moved_ms < REST_MS)
        bounced();
    else
        told(SHUTTER, rising, at);
    moved_ms = at.ms;
    follow_level();
}

ISR(INT1_vect)
{
    told(PPS, true, clock_instant(TCNT1));
}

void pulses_init(void)
{
    PORTB |= _BV(PIN_SHUTTER); // pulled up: the contact closes to ground
    TCCR1B |= _BV(ICNC1);      // an edge must last four cycles
    follow_level();
    TIFR = _BV(ICF1); // the change may have set it; later a flag that it sets counts as a bounce
    TIMSK |= _BV(TICIE1);
    PPS_ENABLE();
}

void pulses_poll(uint32_t now)
{
    struct pulse first;
    bool any;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        bool low = !(PINB & _BV(PIN_SHUTTER)), waits_for_rise = TCCR1B & _BV(ICES1);
        if (low != waits_for_rise && !(TIFR & _BV(ICF1))) {
            // It moved again before its capture was set for that: one of the bounces.
            bounced();
            moved_ms = now;
            follow_level();
        }
        any = waiting;
        first = queue[0];
    }
    if (!any)
        return;
    frame_begin('P');
    frame_field(first.kind, 1);
    frame_field(first.number, 1);
    frame_field(first.bounces, 1);
    frame_field(first.at.ms, 4);
    frame_field(first.at.us, 2);
    if (!frame_send())
        return; // again, once there is room
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        waiting--;
        for (uint8_t i = 0; i < waiting; i++)
            queue[i] = queue[i + 1];
    }
}
