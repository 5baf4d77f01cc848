// SPDX-License-Identifier: Apache-2.0
// A sample is the mean of bursts, one each 20 ms of its period; a burst is four conversions X Y Y X, so that X and Y have
// the same middle. All of it hangs on the millisecond clock: a burst begins at a tick, and the line is sent at the tick
// at which the last burst must have ended, so the time from the conversions to the line is one number.
#include "sampler.h"

#include "ad7730.h"
#include "clock.h"
#include "frame.h"
#include "sca100t.h"

// The F field of `T`.
#define ADC_TIMEOUT 0x01
#define NO_REFERENCE 0x02
#define NO_TEMPERATURE 0x04
#define FIRST 0x08
#define WATCHDOG 0x10
#define OVERRUN 0x20

#define CODE_ZERO 0x800000UL
#define WINDOW_MS 20 // of a burst: the period of the highest rate
#define CONVERSIONS 4
#define PER_CHANNEL (CONVERSIONS / 2)
#define TRANSFERS_US 250 // reading a conversion and starting the next one, measured
#define BEGIN_US 250     // from the tick to the first conversion, measured
#define BURST_US (CONVERSIONS * (AD7730_SETTLING_PERIODS * AD7730_PERIOD_NS / 1000 + TRANSFERS_US))
#define HALF_BURST_MS ((BEGIN_US + BURST_US / 2 + 500) / 1000)
#define SENDING_MS 1 // from the tick to the first byte of the line: 0.92, measured
#define SPARE_US (CONVERSIONS * AD7730_PERIOD_NS / 1000) // should each conversion take one period more
_Static_assert(BEGIN_US + BURST_US + SPARE_US < WINDOW_MS * 1000UL, "a burst must fit its window");

#define RESET_MS 2
#define SETUP_MS (RESET_MS + AD7730_CALIBRATION_MS + 50) // with a margin for both clocks

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

static uint8_t rate_hz = SAMPLER_DEFAULT_HZ;
static uint32_t due;     // when the next sample begins
static uint8_t fraction; // of a millisecond, in 1 / rate_hz
static uint16_t sequence;

static bool sampling;
static uint32_t began;
static uint8_t burst;
static bool converted; // this burst
static uint32_t sums[2];

static uint32_t codes[2] = {CODE_ZERO, CODE_ZERO};
static uint8_t status = FIRST;

static uint8_t bursts(void)
{
    return 1000 / WINDOW_MS / rate_hz;
}

static uint16_t middle_ms(void)
{
    return (bursts() - 1) * (WINDOW_MS / 2) + HALF_BURST_MS;
}

static void begin_setup(uint32_t now)
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

static void begin_burst(void)
{
    converted = false;
    if (phase == IDLE) { // otherwise the converter is being set up
        step = 0;
        convert();
    }
}

static void on_ready(uint32_t now)
{
    if (ad7730_no_reference()) {
        reference_was_lost = true;
        status |= NO_REFERENCE;
    }
    if (phase == CALIBRATING) {
        if (++step < N_CALIBRATIONS) {
            ad7730_start(CALIBRATIONS[step]);
            return;
        }
    } else {
        sums[CHANNELS[step]] += ad7730_data();
        // Had a spike put the interface out of step, or reset the part, the codes would be anything.
        if (!ad7730_runs(CONVERT[CHANNELS[step]])) {
            begin_setup(now);
            return;
        }
        if (++step < CONVERSIONS) {
            convert();
            return;
        }
        converted = true;
    }
    ad7730_start(AD7730_MODE_IDLE);
    phase = IDLE;
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
    sums[0] = sums[1] = 0;
    sampling = true;
    begin_burst();
}

// Whether that was the sample's last.
static bool end_burst(uint32_t now)
{
    if (!converted) {
        status |= ADC_TIMEOUT;
        if (phase == CONVERTING || (phase != IDLE && now - setup_began >= SETUP_MS))
            begin_setup(now);
    }
    if (++burst < bursts()) {
        begin_burst();
        return false;
    }
    sampling = false;
    return true;
}

static void end_sample(uint32_t now)
{
    if (!(status & ADC_TIMEOUT)) {
        uint8_t count = PER_CHANNEL * bursts();
        for (uint8_t i = 0; i < 2; i++)
            codes[i] = (sums[i] + count / 2) / count;
    }
    if (reference_was_lost && !(status & NO_REFERENCE)) {
        status |= NO_REFERENCE; // converted with a calibration without reference
        begin_setup(now);
    }
}

static void send(uint32_t middle)
{
    uint8_t temperature;
    if (!sca100t_temperature(&temperature))
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
    begin_setup(clock_ms());
    due = clock_ms() + SETUP_MS;
}

void sampler_poll(void)
{
    uint32_t now = clock_ms();
    if (phase == RESETTING && now - setup_began >= RESET_MS)
        configure();
    else if (ad7730_ready() && (phase == CALIBRATING || phase == CONVERTING))
        on_ready(now);
    bool complete = sampling && now - began >= (uint16_t)WINDOW_MS * (burst + 1) && end_burst(now);
    uint32_t middle = began + middle_ms();
    if (complete)
        end_sample(now);
    if ((int32_t)(now - due) >= 0)
        begin_sample(now); // before the line, so that its conversions begin at the tick
    if (complete)
        send(middle);
}

void sampler_set_rate(uint8_t wanted_hz)
{
    if (wanted_hz == rate_hz)
        return;
    rate_hz = wanted_hz;
    sampling = false;
    if (phase == CONVERTING) {
        ad7730_start(AD7730_MODE_IDLE);
        phase = IDLE;
    }
    status &= ~(ADC_TIMEOUT | NO_REFERENCE);
    fraction = 0;
    if (phase == IDLE) // otherwise it is being set up, and the first sample waits for that
        due = clock_ms() + 1;
}

uint8_t sampler_rate_hz(void)
{
    return rate_hz;
}

uint16_t sampler_delay_ms(void)
{
    return WINDOW_MS * bursts() - middle_ms() + SENDING_MS;
}
