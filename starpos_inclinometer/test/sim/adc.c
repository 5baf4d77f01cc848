// SPDX-License-Identifier: Apache-2.0
// Written from the AD7730 data sheet (rev. A), apart from the firmware's header, so that the two check each other.
#include "adc.h"

#include <math.h>

#include "complain.h"

#define CLOCK_HZ 4.9152e6
#define REFERENCE_V 5.0
#define DIVIDER 31.0 // 30 kohm and 1 kohm, to half the supply
#define PARTS 4      // of a conversion, over which the input is averaged
#define NOISE_V 1.4e-6
// What self-calibration takes away: share of the gain, and volts at the input, of each channel.
static const double GAIN_ERROR[2] = {0.02, -0.015}, OFFSET_V[2] = {40e-6, -25e-6};

enum { COMMUNICATIONS, DATA, MODE, FILTER, DAC, OFFSET, GAIN, TEST };
static const uint8_t BYTES[] = {1, 3, 2, 3, 1, 3, 3, 3};
enum { IDLE, CONTINUOUS, SINGLE, STANDBY, ZERO_SCALE, FULL_SCALE };

// With its interface out of step the converter cannot know what the firmware meant.
static void object(const struct adc *a, const char *what)
{
    if (!a->slipped)
        complain(what);
}

static unsigned running(const struct adc *a)
{
    return a->mode >> 13;
}

static unsigned channel(const struct adc *a)
{
    return a->mode & 3;
}

static bool chopping(const struct adc *a)
{
    return a->filter & 0x10;
}

static double period(const struct adc *a)
{
    return (chopping(a) ? 3 : 1) * 16.0 * (a->filter >> 12) / CLOCK_HZ;
}

static double duration(const struct adc *a)
{
    bool chop = chopping(a), skip = a->filter & 0x200, fast = a->filter & 0x100;
    switch (running(a)) {
    case ZERO_SCALE:
        return (chop ? 22 : 24) * period(a);
    case FULL_SCALE:
        return (chop ? 44 : 48) * period(a);
    case CONTINUOUS:
    case SINGLE:
        return (skip || fast ? (chop ? 2 : 3) : (chop ? 22 : 24)) * period(a);
    default:
        return 0;
    }
}

void adc_power_on(struct adc *a)
{
    bool frozen = a->frozen, missing = a->reference_missing;
    unsigned resets = a->resets + 1, conversions = a->conversions;
    *a = (struct adc){.mode = 0x01B0, .filter = 0x200010, .dac = 0x20};
    a->frozen = frozen;
    a->reference_missing = missing;
    a->resets = resets;
    a->conversions = conversions;
}

void adc_interrupt(struct adc *a)
{
    if (a->left)
        a->slipped = true;
}

static void check_filter(const struct adc *a)
{
    unsigned sf = a->filter >> 12, lowest[] = {150, 75, 40, 20}; // SKIP, CHP
    if (a->filter & 0xCC0)
        object(a, "AD7730 filter register: a bit that must be 0 is 1");
    if (sf < lowest[(a->filter & 0x200 ? 2 : 0) + chopping(a)] || sf > 2048)
        object(a, "AD7730 filter register: SF outside of table XV");
}

static void start(struct adc *a, double now)
{
    if (a->mode & 0x0040)
        object(a, "AD7730 mode register: a bit that must be 0 is 1");
    if ((a->mode & 0x1000) || channel(a) > 1 || !(a->mode & 0x0100))
        object(a, "AD7730 mode register: unipolar, 16 bits or a channel that is not wired");
    if (running(a) > FULL_SCALE || running(a) == STANDBY)
        object(a, "AD7730 mode register: an operating mode this board has no use for");
    if (running(a) == ZERO_SCALE && !a->full_scale[channel(a) & 1] && !a->reference_missing)
        object(a, "AD7730 zero-scale calibration before the full-scale one");
    a->ready = false;
    a->pulse = 0;
    a->began = now;
    a->next = running(a) == IDLE ? 0 : now + duration(a);
}

static void write(struct adc *a, double now)
{
    if (a->address == MODE) {
        a->mode = a->shift;
        start(a, now);
    } else if (a->address == FILTER) {
        a->filter = a->shift;
        check_filter(a);
    } else if (a->address == DAC) {
        a->dac = a->shift;
    } else {
        object(a, "AD7730 write to a register that is the calibration's or no one's");
    }
}

static uint32_t value(const struct adc *a)
{
    switch (a->address) {
    case COMMUNICATIONS:
        return (a->ready ? 0 : 0x80) | (a->no_reference ? 0x10 : 0);
    case DATA:
        return a->data;
    case MODE:
        return a->mode;
    case FILTER:
        return a->filter;
    case DAC:
        return a->dac;
    default:
        object(a, "AD7730 read of a register the model has not");
        return 0;
    }
}

static void communicate(struct adc *a, uint8_t in)
{
    if (in & 0x80)
        return; // WEN: nothing is written
    if (in & 0x48)
        object(a, "AD7730 communications register: a bit that must be 0 is 1");
    if (in & 0x20)
        object(a, "AD7730 continuous read, which the model has not");
    a->address = in & 7;
    a->reading = in & 0x10;
    a->left = BYTES[a->address];
    a->shift = a->reading ? value(a) << (24 - 8 * a->left) : 0;
    if (a->reading && a->address == DATA && !a->ready)
        object(a, "AD7730 data read while RDY was high");
}

uint8_t adc_transfer(struct adc *a, uint8_t in, double now)
{
    for (int bit = 7; bit >= 0; bit--) {
        a->ones = in >> bit & 1 ? a->ones + 1 : 0;
        if (a->ones == 32) {
            adc_power_on(a);
            a->ones = 0;
            return 0xFF;
        }
    }
    if (a->slips_after && !--a->slips_after) {
        a->slipped = true;
        a->left++;
    }
    if (!a->left) {
        communicate(a, in);
        return 0xFF;
    }
    a->left--;
    if (a->reading) {
        uint8_t out = a->shift >> 16;
        a->shift <<= 8;
        if (!a->left && a->address == DATA)
            a->ready = false;
        return out;
    }
    a->shift = a->shift << 8 | in;
    if (!a->left)
        write(a, now);
    return 0xFF;
}

double adc_next_event(const struct adc *a)
{
    if (a->frozen || !a->next)
        return a->pulse;
    return a->pulse ? fmin(a->next, a->pulse) : a->next;
}

static uint32_t convert(struct adc *a, struct sensor *s)
{
    unsigned axis = channel(a) & 1;
    double volts = 0;
    for (int part = 0; part < PARTS; part++) {
        double at = a->began + (a->next - a->began) * (part + 0.5) / PARTS;
        volts += (sensor_volts(s, axis, at) - REFERENCE_V / 2) / DIVIDER / PARTS;
    }
    volts += NOISE_V * gaussian();
    if (!a->full_scale[axis])
        volts *= 1 + GAIN_ERROR[axis];
    if (!a->zero_scale[axis])
        volts += OFFSET_V[axis];
    double range = ldexp(0.010, a->mode >> 4 & 3) * REFERENCE_V / (a->mode & 0x80 ? 5.0 : 2.5);
    // The DAC's offset, in steps of VREF / 2000, DAC5 at 1 subtracting.
    volts -= (a->dac & 0x20 ? 1 : -1) * (a->dac & 0x1F) * REFERENCE_V / 2000;
    return lround(fmin(fmax((1 + volts / range) * 0x800000, 0), 0xFFFFFF));
}

static void finish(struct adc *a, struct sensor *s, double now)
{
    unsigned mode = running(a), axis = channel(a) & 1;
    a->no_reference = a->reference_missing;
    if (mode == CONTINUOUS || mode == SINGLE) {
        a->data = a->no_reference ? 0xFFFFFF : convert(a, s);
        a->conversions++;
    } else if (!a->no_reference) {
        if (mode == FULL_SCALE) {
            a->full_scale[axis] = true;
            a->zero_scale[axis] = false;
        } else {
            a->zero_scale[axis] = true;
        }
    }
    if (mode == CONTINUOUS) {
        a->began = now;
        a->next = now + period(a);
    } else {
        a->mode &= 0x1FFF;
        a->next = 0;
    }
    if (a->ready) { // the result before was not read: RDY goes high for 100 clocks
        a->ready = false;
        a->pulse = now + 100 / CLOCK_HZ;
    } else {
        a->ready = true;
    }
}

void adc_event(struct adc *a, struct sensor *s, double now)
{
    if (a->pulse && a->pulse <= now) {
        a->pulse = 0;
        a->ready = true;
    }
    if (!a->frozen && a->next && a->next <= now)
        finish(a, s, now);
}
