// SPDX-License-Identifier: Apache-2.0
// AD7730 and SCA100T-D01. A burst is four conversions X Y Y X, so that X and Y have the same middle.
#include "front.h"

#include "ad7730.h"
#include "sca100t.h"

#define CONVERSIONS 4
#define PER_CHANNEL (CONVERSIONS / 2)
#define TRANSFERS_US 250 // reading a conversion and starting the next one, measured
#define BEGIN_US 250     // from the tick to the first conversion, measured
#define BURST_US (CONVERSIONS * (AD7730_SETTLING_PERIODS * AD7730_PERIOD_NS / 1000 + TRANSFERS_US))
#define SPARE_US (CONVERSIONS * AD7730_PERIOD_NS / 1000) // should each conversion take one period more
_Static_assert(BEGIN_US + BURST_US + SPARE_US < WINDOW_MS * 1000UL, "a burst must fit its window");

#define RESET_MS 2
#define SETUP_MS (RESET_MS + AD7730_CALIBRATION_MS + 50) // with a margin for both clocks

const uint8_t front_half_burst_ms = (BEGIN_US + BURST_US / 2 + 500) / 1000;
const uint16_t front_setup_ms = SETUP_MS;

static const uint8_t CHANNELS[CONVERSIONS] = {0, 1, 1, 0};
static const uint16_t CONVERT[] = {
    AD7730_MODE_CONTINUOUS | AD7730_MODE_CHANNEL_1,
    AD7730_MODE_CONTINUOUS | AD7730_MODE_CHANNEL_2,
};

// Full scale before zero scale is a full self-calibration (table XVII, p. 22).
static const uint16_t CALIBRATIONS[] = {
    AD7730_MODE_FULL_SCALE | AD7730_MODE_CHANNEL_1,
    AD7730_MODE_ZERO_SCALE | AD7730_MODE_CHANNEL_1,
    AD7730_MODE_FULL_SCALE | AD7730_MODE_CHANNEL_2,
    AD7730_MODE_ZERO_SCALE | AD7730_MODE_CHANNEL_2,
};
#define N_CALIBRATIONS (sizeof CALIBRATIONS / sizeof CALIBRATIONS[0])

static enum { RESETTING, CALIBRATING, IDLE, CONVERTING } phase;
static uint8_t step; // of the calibrations or the burst
static uint32_t setup_began;
static bool reference_was_lost; // the calibration is not to be trusted

static bool converted; // this burst
static bool without_reference;
static uint32_t sums[2];
static uint32_t codes[2] = {CODE_ZERO, CODE_ZERO};

void front_init(void)
{
    ad7730_init();
}

void front_begin_setup(uint32_t now)
{
    ad7730_reset();
    setup_began = now;
    phase = RESETTING;
}

static void configure(void)
{
    ad7730_configure();
    reference_was_lost = false;
    step = 0;
    ad7730_start(CALIBRATIONS[0]);
    phase = CALIBRATING;
}

static void convert(void)
{
    ad7730_start(CONVERT[CHANNELS[step]]);
    phase = CONVERTING;
}

void front_begin_sample(void)
{
    sums[0] = sums[1] = 0;
}

void front_begin_burst(void)
{
    converted = false;
    if (phase == IDLE) { // otherwise the converter is being set up
        step = 0;
        convert();
    }
}

static void on_ready(uint32_t now)
{
    if (ad7730_no_reference())
        reference_was_lost = without_reference = true;
    if (phase == CALIBRATING) {
        if (++step < N_CALIBRATIONS) {
            ad7730_start(CALIBRATIONS[step]);
            return;
        }
    } else {
        sums[CHANNELS[step]] += ad7730_data();
        // Had a spike put the interface out of step, or reset the part, the codes would be anything.
        if (!ad7730_runs(CONVERT[CHANNELS[step]])) {
            front_begin_setup(now);
            return;
        }
        if (++step < CONVERSIONS) {
            convert();
            return;
        }
        converted = true;
    }
    front_abandon();
}

void front_poll(uint32_t now)
{
    if (phase == RESETTING && now - setup_began >= RESET_MS)
        configure();
    else if (ad7730_ready() && (phase == CALIBRATING || phase == CONVERTING))
        on_ready(now);
}

bool front_pending(void)
{
    return ad7730_ready();
}

uint8_t front_end_burst(uint32_t now)
{
    uint8_t status = without_reference ? MEANINGLESS : 0;
    without_reference = false;
    if (converted)
        return status;
    if (phase == CONVERTING || (phase != IDLE && now - setup_began >= SETUP_MS))
        front_begin_setup(now);
    return status | NO_ANSWER;
}

void front_abandon(void)
{
    ad7730_start(AD7730_MODE_IDLE);
    phase = IDLE;
}

bool front_idle(void)
{
    return phase == IDLE || phase == CONVERTING;
}

uint8_t front_end_sample(uint32_t now, uint8_t bursts, uint8_t status)
{
    if (!(status & NO_ANSWER)) {
        uint8_t count = PER_CHANNEL * bursts;
        for (uint8_t i = 0; i < 2; i++)
            codes[i] = (sums[i] + count / 2) / count;
    }
    if (!reference_was_lost || (status & MEANINGLESS))
        return 0;
    front_begin_setup(now);
    return MEANINGLESS; // converted with a calibration without reference
}

uint32_t front_code(uint8_t axis)
{
    return codes[axis];
}

bool front_temperature(uint8_t *counts)
{
    return sca100t_temperature(counts);
}
