// SPDX-License-Identifier: Apache-2.0
// SCL3300-D01. A burst is one reading of all registers at the window's begin; the sensor filters to 40 Hz by itself.
// Murata SCL3300-D01, Doc. 4921 Rev. 2; tables and sections are its.
#include "front.h"

#include <util/delay.h>

#include "spi.h"

// Operations (table 15): read or write, and the register; the low 16 bits are the data of a write.
#define SCL3300_READ(address) ((uint32_t)(address) << 26)
#define SCL3300_WRITE(address, data) (0x80000000UL | (uint32_t)(address) << 26 | (uint32_t)(data) << 8)

#define SCL3300_SELF_TEST_OUTPUT 0x04
#define SCL3300_TEMPERATURE 0x05
#define SCL3300_STATUS 0x06
#define SCL3300_ANGLE_X 0x09
#define SCL3300_ANGLE_Y 0x0A
#define SCL3300_ANGLE_Z 0x0B
#define SCL3300_ANGLE_CONTROL 0x0C
#define SCL3300_MODE 0x0D
#define SCL3300_WHOAMI 0x10

#define SCL3300_MODE_1 0x00 // 1.8 g, 40 Hz: the one that measures at any lean
#define SCL3300_SOFTWARE_RESET 0x20
#define SCL3300_ANGLES_ON 0x1F
#define SCL3300_IDENTITY 0xC1

// Start-up (table 11): after the supply, after the reset, until the signal path has settled in mode 1.
#define SCL3300_POWER_MS 10
#define SCL3300_RESET_MS 2
#define SCL3300_SETTLING_MS 26
#define SCL3300_QUARTER_TURN 16384     // an angle of 90 deg
#define SCL3300_SELF_TEST_LIMIT 1800   // of its output in mode 1 (section 2.4)

enum scl3300_answer {
    SCL3300_GOOD,
    SCL3300_WRONG,   // the CRC or the register: a broken line, or no sensor
    SCL3300_FAILING, // the return status is an error, or it is starting up
};

#define SETUP_MS (SCL3300_POWER_MS + SCL3300_RESET_MS + SCL3300_SETTLING_MS + WINDOW_MS)
#define CODE_PER_ANGLE 256 // 90 deg are 2^22 codes
#define TEMPERATURE_SHIFT 4
#define TEMPERATURE_ZERO 256 // T = TEMP / 16 - 256, for -40 to 125 deg C: 19 to 214

const uint8_t front_half_burst_ms = 0; // both angles are read within 0.5 ms of the tick, measured
const uint16_t front_setup_ms = SETUP_MS;
const uint8_t front_readings = 1;

static enum { POWERING, RESETTING, SETTLING, RUNNING } phase;
static uint32_t phase_began;
static bool begun; // a burst; measured by the next poll

static uint8_t burst_status;
static uint16_t temperature;

// Mode 0; 2 MHz, 2 to 4 MHz are recommended.
#define CONTROL (SPI_MODE_0 | SPI_BY_8)
#define POLYNOMIAL 0x1D // x^8 + x^4 + x^3 + x^2 + 1 (section 5.1.6), from all ones, inverted
#define REGISTER 0xFC   // of the first byte: write, address
#define RETURN_STATUS 0x03
#define NORMAL 0x01

static uint8_t asked; // the first byte of the frame before, 0xFF: none

static uint8_t crc(const uint8_t *bytes)
{
    uint8_t sum = 0xFF;
    for (uint8_t i = 0; i < 3; i++) {
        sum ^= bytes[i];
        for (uint8_t bit = 0; bit < 8; bit++)
            sum = sum & 0x80 ? sum << 1 ^ POLYNOMIAL : sum << 1;
    }
    return ~sum;
}

// Sends a frame; what comes back answers the one before (section 5.1.3), which *answer becomes of.
static enum scl3300_answer scl3300_frame(uint32_t operation, uint16_t *answer)
{
    uint8_t out[4] = {operation >> 24, operation >> 16, operation >> 8}, in[4];
    uint8_t wanted = asked;
    out[3] = crc(out);
    asked = out[0];
    _delay_us(10); // CSB high between frames (section 5.1.2)
    spi_select(CONTROL, PIN_SCL3300_CS);
    for (uint8_t i = 0; i < 4; i++)
        in[i] = spi_transfer(out[i]);
    spi_release();
    *answer = (uint16_t)in[1] << 8 | in[2];
    if (in[3] != crc(in) || (in[0] & REGISTER) != wanted)
        return SCL3300_WRONG;
    return (in[0] & RETURN_STATUS) == NORMAL ? SCL3300_GOOD : SCL3300_FAILING;
}

static void enter(uint8_t next, uint32_t now)
{
    phase = next;
    phase_began = now;
}

void front_begin_setup(uint32_t now)
{
    enter(POWERING, now);
}

// The last step of starting up: the status clears by being read, and then must be good.
static bool is_well(void)
{
    uint16_t answer;
    scl3300_frame(SCL3300_READ(SCL3300_STATUS), &answer);
    scl3300_frame(SCL3300_READ(SCL3300_STATUS), &answer);
    scl3300_frame(SCL3300_READ(SCL3300_STATUS), &answer);
    scl3300_frame(SCL3300_READ(SCL3300_WHOAMI), &answer);
    return scl3300_frame(SCL3300_READ(SCL3300_STATUS), &answer) == SCL3300_GOOD && answer == SCL3300_IDENTITY;
}

// The elevation of an axis: an angle beyond 90 deg has that of its supplement.
static int16_t elevation(uint16_t raw)
{
    int16_t angle = raw;
    if (angle > SCL3300_QUARTER_TURN)
        return (int32_t)2 * SCL3300_QUARTER_TURN - angle;
    if (angle < -SCL3300_QUARTER_TURN)
        return (int32_t)-2 * SCL3300_QUARTER_TURN - angle;
    return angle;
}

// Reads all registers; each answer comes with the frame after.
static uint8_t measure(void)
{
    static const uint8_t REGISTERS[] = {SCL3300_ANGLE_X,     SCL3300_ANGLE_Y, SCL3300_ANGLE_Z, SCL3300_SELF_TEST_OUTPUT,
                                        SCL3300_TEMPERATURE, SCL3300_STATUS,  SCL3300_STATUS};
    enum { X, Y, Z, SELF_TEST_OUTPUT, TEMPERATURE, STATUS, COUNT };
    uint16_t answers[COUNT], old;
    uint8_t status = 0;
    scl3300_frame(SCL3300_READ(REGISTERS[0]), &old);
    for (uint8_t i = 0; i < COUNT; i++) {
        enum scl3300_answer answer = scl3300_frame(SCL3300_READ(REGISTERS[i + 1]), &answers[i]);
        if (answer == SCL3300_WRONG)
            return NO_ANSWER;
        if (answer == SCL3300_FAILING)
            status = MEANINGLESS;
    }
    if (answers[STATUS])
        status = MEANINGLESS;
    int16_t self_test = answers[SELF_TEST_OUTPUT];
    if (self_test > SCL3300_SELF_TEST_LIMIT || self_test < -SCL3300_SELF_TEST_LIMIT)
        status |= SELF_TEST;
    if (elevation(answers[Z]) < 0)
        status |= UPSIDE_DOWN;
    for (uint8_t i = 0; i < 2; i++)
        front_sums[i] += CODE_ZERO + (int32_t)elevation(answers[i]) * CODE_PER_ANGLE;
    temperature = answers[TEMPERATURE];
    return status;
}

void front_begin_burst(void)
{
    burst_status = NO_ANSWER;
    begun = phase == RUNNING;
}

void front_poll(uint32_t now)
{
    uint16_t answer;
    uint16_t elapsed = now - phase_began;
    if (phase == RUNNING && begun) {
        begun = false;
        burst_status = measure();
        // A sensor that lost its supply has lost its mode and its angles too: it is set up again, whatever it was.
        if (burst_status & (NO_ANSWER | MEANINGLESS))
            front_begin_setup(now);
    } else if (phase == POWERING && elapsed >= SCL3300_POWER_MS) {
        scl3300_frame(SCL3300_WRITE(SCL3300_MODE, SCL3300_SOFTWARE_RESET), &answer);
        enter(RESETTING, now);
    } else if (phase == RESETTING && elapsed >= SCL3300_RESET_MS) {
        scl3300_frame(SCL3300_WRITE(SCL3300_MODE, SCL3300_MODE_1), &answer);
        scl3300_frame(SCL3300_WRITE(SCL3300_ANGLE_CONTROL, SCL3300_ANGLES_ON), &answer);
        enter(SETTLING, now);
    } else if (phase == SETTLING && elapsed >= SCL3300_SETTLING_MS) {
        enter(is_well() ? RUNNING : POWERING, now);
    }
}

bool front_pending(void)
{
    return begun;
}

uint8_t front_end_burst(uint32_t now)
{
    (void)now;
    return burst_status;
}

void front_abandon(void)
{
    begun = false;
}

bool front_idle(void)
{
    return phase == RUNNING;
}

bool front_temperature(uint8_t *counts)
{
    uint16_t scaled = temperature >> TEMPERATURE_SHIFT;
    bool sound = scaled >= TEMPERATURE_ZERO && scaled < TEMPERATURE_ZERO + 256;
    *counts = sound ? scaled - TEMPERATURE_ZERO : 0;
    return sound;
}
