// SPDX-License-Identifier: Apache-2.0
// Written from the data sheet (Doc. 4921 Rev. 2), apart from the firmware's header, so that the two check each other. The
// sheet's words for reading and setting, with their checksums, are as published drivers have them (0x240000C7 reads ANG_X,
// 0xB400001F sets mode 1, 0x40000091 reads WHOAMI); the waiting times are from memory.
#include "scl3300.h"

#include <math.h>
#include <string.h>

#include "complain.h"

#define POWER_S 10e-3
#define RESET_S 1e-3
#define SETTLING_S 25e-3 // modes 1 and 2
#define SETTLING_SLOW_S 100e-3
#define BETWEEN_FRAMES_S 10e-6
enum { STO = 0x04, TEMP = 0x05, STATUS = 0x06, ANG_X = 0x09, ANG_Z = 0x0B, ANG_CTRL = 0x0C, MODE = 0x0D, WHOAMI = 0x10 };
enum { STARTING, NORMAL, BUSY, FAILING }; // return status
enum { PIN_CONTINUITY = 0x001, MODE_CHANGE = 0x002, POWER_DOWN = 0x004, SUPPLY = 0x010, SATURATED = 0x040 };

// A bit at a time, as section 5.1.6 draws it: all 24 bits of the frame are shifted through.
static uint8_t crc(const uint8_t *bytes)
{
    uint8_t sum = 0xFF;
    for (int bit = 0; bit < 24; bit++) {
        bool feedback = (sum >> 7) ^ (bytes[bit / 8] >> (7 - bit % 8) & 1);
        sum <<= 1;
        if (feedback)
            sum ^= 1 | 1 << 2 | 1 << 3 | 1 << 4;
    }
    return ~sum;
}

static void reset(struct scl3300 *s, double now)
{
    s->mode = 0;
    s->angles_on = false;
    s->status = SUPPLY | MODE_CHANGE | PIN_CONTINUITY;
    s->reset_at = now;
    s->settled_at = now + SETTLING_S;
    memset(s->out, 0, sizeof s->out);
}

void scl3300_power_on(struct scl3300 *s, double now)
{
    s->powered_at = now;
    s->deselected_at = -1;
    s->count = 0;
    reset(s, now);
}

void scl3300_fail(struct scl3300 *s, uint16_t status)
{
    s->status |= status;
}

static uint16_t angle(const struct scl3300 *s, uint8_t address, struct sensor *feels, double now)
{
    double x = sensor_angle(feels, 0, now), y = sensor_angle(feels, 1, now), up = 1 - pow(sin(x), 2) - pow(sin(y), 2);
    double z = asin(sqrt(fmax(up, 0))) * (s->upside_down ? -1 : 1);
    double angles[] = {x, y, z};
    return s->angles_on ? (uint16_t)lround(angles[address - ANG_X] / (M_PI / 2) * 16384) : 0;
}

static uint16_t value(struct scl3300 *s, uint8_t address, struct sensor *feels, double now)
{
    uint16_t status = s->status;
    switch (address) {
    case ANG_X ... ANG_Z:
        return angle(s, address, feels, now);
    case STO:
        return s->self_test;
    case TEMP:
        return lround((feels->celsius + 273) * 18.9);
    case STATUS:
        if (now >= s->settled_at)
            s->status = 0;
        return status;
    case MODE:
        return s->mode;
    case WHOAMI:
        return 0xC1;
    default:
        complain("SCL3300 read of a register the model has not");
        return 0;
    }
}

static void write(struct scl3300 *s, uint8_t address, uint16_t data, double now)
{
    if (address == MODE && data == 0x20) {
        reset(s, now);
        s->resets++;
    } else if (address == MODE && data <= 3) {
        if (data != s->mode)
            s->status |= MODE_CHANGE;
        s->mode = data;
        s->settled_at = now + (data < 2 ? SETTLING_S : SETTLING_SLOW_S);
    } else if (address == ANG_CTRL && (data & 0x1F) == 0x1F) {
        s->angles_on = true;
    } else {
        complain("SCL3300 write that this board has no use for");
    }
}

static void answer(struct scl3300 *s, struct sensor *feels, double now)
{
    uint8_t address = s->in[0] >> 2 & 0x1F;
    bool writes = s->in[0] & 0x80;
    uint16_t data = (uint16_t)s->in[1] << 8 | s->in[2];
    s->frames++;
    if (now - s->powered_at < POWER_S)
        complain("SCL3300 frame within 10 ms of its power-on");
    if (now - s->reset_at < RESET_S && s->resets)
        complain("SCL3300 frame within 1 ms of its reset");
    if (s->in[3] != crc(s->in)) {
        complain("SCL3300 frame with a wrong CRC");
        return;
    }
    int state = now < s->settled_at ? STARTING : s->status ? FAILING : NORMAL;
    uint16_t said = writes ? data : value(s, address, feels, now);
    if (writes)
        write(s, address, data, now);
    s->out[0] = (s->in[0] & 0xFC) | state;
    s->out[1] = said >> 8;
    s->out[2] = said;
    s->out[3] = crc(s->out);
    if (s->noisy && s->frames % 3 == 0)
        s->out[1] ^= 0x10;
}

void scl3300_select(struct scl3300 *s, bool selected, struct sensor *feels, double now)
{
    if (selected && !s->selected && now - s->deselected_at < BETWEEN_FRAMES_S)
        complain("SCL3300 selected again within 10 us");
    if (!selected && s->selected) {
        if (s->count == 4)
            answer(s, feels, now);
        else if (s->count)
            complain("SCL3300 frame of another length than 32 bits");
        s->deselected_at = now;
    }
    s->selected = selected;
    s->count = 0;
}

uint8_t scl3300_transfer(struct scl3300 *s, uint8_t in, double now)
{
    (void)now;
    uint8_t at = s->count++ & 3;
    s->in[at] = in;
    return s->broken ? 0xFF : s->out[at]; // MISO is pulled up
}
