// SPDX-License-Identifier: Apache-2.0
// AD7730 and SCA100T-D01. A burst is four conversions X Y Y X, so that X and Y have the same middle.
// Registers, bits and times: AD7730/AD7730L data sheet, Analog Devices, rev. A; tables and pages are its. Of the SCA100T's
// SPI side only the temperature is used (data sheet SCA100T series, Murata 8261800 rev. B2).
#include "front.h"

#include <avr/interrupt.h>

#include "spi.h"

// Communications register: what the next transfer is (p. 13), and the register it goes to (table VIII, p. 14).
#define AD7730_WRITE 0x00
#define AD7730_READ 0x10
#define AD7730_STATUS 0x00
#define AD7730_DATA 0x01
#define AD7730_MODE 0x02
#define AD7730_FILTER 0x03

// Status register (table IX, p. 14).
#define AD7730_STATUS_NOREF 0x10 // the reference is below 0.3 V or open (p. 25)

// Mode register, 16 bits (table X, p. 15, and following); 0x01B0 after a reset.
#define AD7730_MODE_IDLE 0x0000           // MD2..MD0 = 000
#define AD7730_MODE_CONTINUOUS 0x2000     // MD = 001
#define AD7730_MODE_ZERO_SCALE 0x8000     // MD = 100: internal zero-scale calibration
#define AD7730_MODE_FULL_SCALE 0xA000     // MD = 101: internal full-scale calibration
#define AD7730_MODE_24_BITS 0x0100        // WL
#define AD7730_MODE_REFERENCE_5V 0x0080   // HIREF
#define AD7730_MODE_RANGE_80MV 0x0030     // RN1, RN0 = 11; bipolar as B/U = 0
#define AD7730_MODE_CHANNEL_1 0x0000      // CH1, CH0: AIN1(+) - AIN1(-)
#define AD7730_MODE_CHANNEL_2 0x0001      // AIN2(+) - AIN2(-)
#define AD7730_MODE_INPUT (AD7730_MODE_24_BITS | AD7730_MODE_REFERENCE_5V | AD7730_MODE_RANGE_80MV)

// Filter register, 24 bits (p. 18, 19); 0x200010 after a reset. Chopping removes the converter's offset and its drift;
// FASTStep gives the first result after a change of channel as the mean of two outputs of the sinc3 filter, which
// are the two halves of the chopping, instead of waiting for the 22 taps of the second filter.
#define AD7730_FILTER_SF_SHIFT 12
#define AD7730_FILTER_FAST 0x000100UL
#define AD7730_FILTER_CHOP 0x000010UL
#define AD7730_SF 150 // chopping without SKIP allows 75 to 2048 (table XV, p. 19)
#define AD7730_FILTER_WORD (((uint32_t)AD7730_SF << AD7730_FILTER_SF_SHIFT) | AD7730_FILTER_FAST | AD7730_FILTER_CHOP)

// Output rate = MCLK / 16 / (3 SF), chopping: 683 Hz.
#define AD7730_PERIOD_NS (3UL * 16 * AD7730_SF * 10000 / (AD7730_CLOCK_HZ / 100000))
#define AD7730_SETTLING_PERIODS 2
// Full-scale and zero-scale calibration take 44 and 22 periods (table XVII, p. 22), each channel its own.
#define AD7730_CALIBRATION_MS (2 * (44 + 22) * AD7730_PERIOD_NS / 1000000 + 1)

// The SCA100T.
#define RWTR 0x08          // "read and write temperature register": 8 bits of command, then 8 of counts
#define COUNTS_AT_125C 62  // 197 - 1.083 x 125
#define COUNTS_AT_M40C 240 // 197 + 1.083 x 40

#define CONVERSIONS 4
#define TRANSFERS_US 250 // reading a conversion and starting the next one, measured
#define BEGIN_US 250     // from the tick to the first conversion, measured
#define BURST_US (CONVERSIONS * (AD7730_SETTLING_PERIODS * AD7730_PERIOD_NS / 1000 + TRANSFERS_US))
#define SPARE_US (CONVERSIONS * AD7730_PERIOD_NS / 1000) // should each conversion take one period more
_Static_assert(BEGIN_US + BURST_US + SPARE_US < WINDOW_MS * 1000UL, "a burst must fit its window");

#define RESET_MS 2
#define SETUP_MS (RESET_MS + AD7730_CALIBRATION_MS + 50) // with a margin for both clocks

const uint8_t front_half_burst_ms = (BEGIN_US + BURST_US / 2 + 500) / 1000;
const uint16_t front_setup_ms = SETUP_MS;
const uint8_t front_readings = CONVERSIONS / 2;

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

// POL high: mode 3; 1 MHz, at most 5 MHz (pulses of 100 ns each).
#define AD7730_CONTROL (SPI_MODE_3 | SPI_BY_8)

static volatile bool ready; // what was started last has a result

ISR(INT0_vect)
{
    ready = true;
}

static void write(uint8_t address, uint32_t value, uint8_t bytes)
{
    spi_select(AD7730_CONTROL, PIN_AD7730_CS);
    spi_transfer(AD7730_WRITE | address);
    while (bytes--)
        spi_transfer(value >> (8 * bytes));
    spi_release();
}

static uint32_t read(uint8_t address, uint8_t bytes)
{
    uint32_t value = 0;
    spi_select(AD7730_CONTROL, PIN_AD7730_CS);
    spi_transfer(AD7730_READ | address);
    while (bytes--)
        value = value << 8 | spi_transfer(0); // zeros: ones at DIN would count towards a reset
    spi_release();
    return value;
}

// 32 ones at DIN; wait a millisecond before the next access.
static void reset(void)
{
    spi_select(AD7730_CONTROL, PIN_AD7730_CS);
    for (uint8_t i = 0; i < 5; i++) // at least 32 clocks with DIN high, wherever the interface stood
        spi_transfer(0xFF);
    spi_release();
}

// A calibration, conversions or none: one of the modes, and a channel.
static void start(uint16_t mode)
{
    write(AD7730_MODE, mode | AD7730_MODE_INPUT, 2);
    // Only now: until the mode is written, the conversions before this one may end.
    GIFR = _BV(INTF0);
    ready = false;
}

static bool no_reference(void)
{
    return read(AD7730_STATUS, 1) & AD7730_STATUS_NOREF;
}

// Whether the mode register still holds what `start` put there.
static bool runs(uint16_t mode)
{
    return read(AD7730_MODE, 2) == (mode | AD7730_MODE_INPUT);
}

void front_begin_setup(uint32_t now)
{
    MCUCR |= _BV(ISC01); // INT0 at the falling edge of RDY
    GICR |= _BV(INT0);
    reset();
    setup_began = now;
    phase = RESETTING;
}

static void configure(void)
{
    write(AD7730_FILTER, AD7730_FILTER_WORD, 3); // the DAC register adds no offset after a reset (table XVI, p. 20)
    reference_was_lost = false;
    step = 0;
    start(CALIBRATIONS[0]);
    phase = CALIBRATING;
}

static void convert(void)
{
    start(CONVERT[CHANNELS[step]]);
    phase = CONVERTING;
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
    if (no_reference())
        reference_was_lost = without_reference = true;
    if (phase == CALIBRATING) {
        if (++step < N_CALIBRATIONS) {
            start(CALIBRATIONS[step]);
            return;
        }
    } else {
        front_sums[CHANNELS[step]] += read(AD7730_DATA, 3);
        // Had a spike put the interface out of step, or reset the part, the codes would be anything.
        if (!runs(CONVERT[CHANNELS[step]])) {
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
    else if (ready && (phase == CALIBRATING || phase == CONVERTING))
        on_ready(now);
}

bool front_pending(void)
{
    return ready;
}

uint8_t front_end_burst(uint32_t now)
{
    uint8_t status = without_reference ? MEANINGLESS : 0;
    without_reference = false;
    if (converted) {
        if (!reference_was_lost || status)
            return status;
        front_begin_setup(now);
        return MEANINGLESS; // converted with a calibration without reference
    }
    if (phase == CONVERTING || (phase != IDLE && now - setup_began >= SETUP_MS))
        front_begin_setup(now);
    return status | NO_ANSWER;
}

void front_abandon(void)
{
    start(AD7730_MODE_IDLE);
    phase = IDLE;
}

bool front_idle(void)
{
    return phase == IDLE || phase == CONVERTING;
}

// Between two commands CSB must be high for 150 us; they are a sample, at least 20 ms, apart.
bool front_temperature(uint8_t *counts)
{
    spi_select(SPI_MODE_0 | SPI_BY_32, PIN_SCA100T_CS); // 250 kHz, at most 500 kHz
    spi_transfer(RWTR);
    *counts = spi_transfer(0);
    spi_release();
    return *counts >= COUNTS_AT_125C && *counts <= COUNTS_AT_M40C;
}
