// SPDX-License-Identifier: Apache-2.0
// A sample is the mean of bursts, one each 20 ms of its period. All of it hangs on the millisecond clock: a burst begins
// at a tick, and the line is sent at the tick at which the last burst must have ended, so the time from the measurement to
// the line is one number.
#include "sampler.h"

#include "clock.h"
#include "frame.h"
#include "front.h"

#define SENDING_MS 1 // from the tick to the first byte of the line: 0.92 at 8 MHz, 0.4 at 16 MHz, measured

static uint8_t rate_hz = SAMPLER_DEFAULT_HZ;
static uint32_t due;     // when the next sample begins
static uint8_t fraction; // of a millisecond, in 1 / rate_hz
static uint16_t sequence;

static bool sampling;
static uint32_t began;
static uint8_t burst;
static uint8_t status = FIRST;
uint32_t front_sums[2];
static uint32_t codes[2] = {CODE_ZERO, CODE_ZERO}; // of the last good sample

static uint8_t bursts(void)
{
    return 1000 / WINDOW_MS / rate_hz;
}

static uint16_t middle_ms(void)
{
    return (bursts() - 1) * (WINDOW_MS / 2) + front_half_burst_ms;
}

static void begin_sample(uint32_t now)
{
    fraction += 1000 % rate_hz;
    due += 1000 / rate_hz;
    if (fraction >= rate_hz) {
        fraction -= rate_hz;
        due++;
    }
    began = now;
    burst = 0;
    sampling = true;
    front_sums[0] = front_sums[1] = 0;
    front_begin_burst();
}

// Whether that was the sample's last.
static bool end_burst(uint32_t now)
{
    status |= front_end_burst(now);
    if (++burst < bursts()) {
        front_begin_burst();
        return false;
    }
    sampling = false;
    uint8_t count = front_readings * bursts();
    for (uint8_t i = 0; i < 2 && !(status & NO_ANSWER); i++)
        codes[i] = (front_sums[i] + count / 2) / count;
    return true;
}

static void send(uint32_t middle)
{
    uint8_t temperature;
    if (!front_temperature(&temperature))
        status |= NO_TEMPERATURE;
    frame_begin('T');
    frame_field(sequence++, 2);
    frame_field(middle, 4);
    frame_field(codes[0], 3);
    frame_field(codes[1], 3);
    frame_field(temperature, 1);
    frame_field(status, 1);
    status = frame_send() ? 0 : OVERRUN;
}

void sampler_init(bool after_watchdog)
{
    if (after_watchdog)
        status |= WATCHDOG;
    front_begin_setup(clock_ms());
    due = clock_ms() + front_setup_ms;
}

void sampler_poll(void)
{
    uint32_t now = clock_ms();
    front_poll(now);
    bool complete = sampling && now - began >= (uint16_t)WINDOW_MS * (burst + 1) && end_burst(now);
    uint32_t middle = began + middle_ms();
    if ((int32_t)(now - due) >= 0)
        begin_sample(now); // before the line, so that its burst begins at the tick
    if (complete)
        send(middle);
}

void sampler_set_rate(uint8_t wanted_hz)
{
    if (wanted_hz == rate_hz)
        return;
    rate_hz = wanted_hz;
    sampling = false;
    status &= ~(NO_ANSWER | MEANINGLESS | UPSIDE_DOWN | SELF_TEST);
    fraction = 0;
    if (front_idle()) { // otherwise it is being set up, and the first sample waits for that
        front_abandon();
        due = clock_ms() + 1;
    }
}

uint8_t sampler_rate_hz(void)
{
    return rate_hz;
}

uint16_t sampler_delay_ms(void)
{
    return WINDOW_MS * bursts() - middle_ms() + SENDING_MS;
}
